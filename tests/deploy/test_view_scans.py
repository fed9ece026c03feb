"""`asca view`: the page gets points and boxes of the scans that were given, and nobody gets anything else."""

import http.client
import json
import signal
import socket
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asca_deploy import Detector, sample_scan_path
from asca_deploy.open_model import RuntimeOptions
from asca_deploy.view_scans import ScanServer
from asca_pillars.base.errors import ConfigError, ScanError
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_reader import read_scan, write_scan
from asca_pillars.scans.scan_settings import ScanSettings
from tests.deploy.chromium import CHROMIUM, open_tab
from tests.deploy.page_driver import assert_drawn, failure, finished, move_slider
from tests.helpers.bundles import DENSE_INT8

POINTS = read_scan(sample_scan_path()).points[::2].copy()
SMALL = RuntimeOptions(bundle="fast", threads=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scans, and between them one that cannot be read."""
    folder = tmp_path_factory.mktemp("view") / "scans"
    write_scan(folder / "1.bin", POINTS)
    (folder / "2.bin").write_bytes(b"torn!")
    np.save(folder / "10.npy", POINTS[::2])
    (folder.parent / "secret.txt").write_text("secret")
    return folder


@contextmanager
def serving(*args: Any, bundle: str = "fast", **kwargs: Any) -> Iterator[ScanServer]:
    with ScanServer(*args, options=RuntimeOptions(bundle=bundle, threads=1), **kwargs) as server:
        thread = threading.Thread(target=server.serve)
        thread.start()
        yield server
        server.stop()
        thread.join()


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[ScanServer]:
    with serving([folder], around=False) as server:
        yield server


def get(server: ScanServer, path: str) -> bytes:
    with urllib.request.urlopen(server.address + path, timeout=60) as answer:
        return bytes(answer.read())


def status(server: ScanServer, path: str, method: str = "GET", **headers: str) -> int:
    """The answer to a path as it is, which urllib would tidy up."""
    connection = http.client.HTTPConnection("127.0.0.1", int(server.address.split(":")[-1].strip("/")), timeout=60)
    connection.putrequest(method, path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    assert b"secret" not in answer.read()
    connection.close()
    return answer.status


def test_the_page_gets_points_and_the_boxes_that_the_detector_finds(server: ScanServer) -> None:
    page = json.loads(get(server, "page.json"))
    assert page["scans"] == ["1.bin", "2.bin", "10.npy"] == server.names
    assert set(page["colors"]) == {"Car", "Pedestrian", "Cyclist"}
    assert b"<!doctype html>" in get(server, "") and b"Scene" in get(server, "main.js")
    np.testing.assert_array_equal(np.frombuffer(get(server, "scans/0.bin"), "<f4").reshape(-1, 4), POINTS)
    found = json.loads(get(server, "scans/0.json"))
    detector = Detector(SMALL.bundle, threads=1)
    assert {one["name"]: one["score"] for one in page["classes"]} == {
        one.name: one.score_threshold for one in detector.spec.classes
    }
    assert {one["lowest"] for one in page["classes"]} == {0.1}
    fewer, expected = shown(page, found), detector(POINTS)
    assert len(found["detections"]) > len(fewer) and len(fewer) == len(expected) > 3  # more for the sliders
    expected = Detector(SMALL.bundle, threads=1, score_threshold=0.1)(POINTS)
    assert [one["class"] for one in found["detections"]] == list(expected.names)
    np.testing.assert_array_equal(np.array([one["box"] for one in found["detections"]], np.float32), expected.boxes)
    assert found["save"]["boxes"] == expected.to_dicts()
    assert found["save"]["made_by"] == dict(expected.made_by)
    assert found["save"]["points"] == len(POINTS) and found["timesMs"].keys() == expected.report.times_ms.keys()


def shown(page: Any, found: Any) -> list[Any]:
    """The boxes that the page shows before a slider is moved, as they are saved."""
    scores = {one["name"]: one["score"] for one in page["classes"]}
    return [one for one in found["save"]["boxes"] if one["score"] >= scores[one["class"]]]


def test_what_several_passes_find_is_not_lowered() -> None:
    """Of two passes the box stays that is seen nearest to straight ahead, whatever the scores."""
    with serving([sample_scan_path()], around=True, bundle=str(DENSE_INT8)) as server:
        classes = json.loads(get(server, "page.json"))["classes"]
    assert [one["lowest"] for one in classes] == [one["score"] for one in classes]


def test_a_scan_that_cannot_be_read_is_said_and_others_go_on(server: ScanServer) -> None:
    for suffix in ("bin", "json"):
        with pytest.raises(urllib.error.HTTPError) as error:
            get(server, f"scans/1.{suffix}")
        assert error.value.code == 422 and b"2.bin: file size (5 bytes)" in error.value.read()
    assert len(json.loads(get(server, "scans/2.json"))["detections"]) > 0


@pytest.mark.parametrize(
    "path",
    [
        "/../secret.txt",
        "/scans/../../secret.txt",
        "/%2e%2e/secret.txt",
        "//etc/passwd",
        "/scans",
        "/scans/3.json",
        "/scans/-1.json",
        "/scans/00.bin",
        "/scans/0.bin/../../../secret.txt",
        "/scans/1.bin%00",
        "/main.js/",
        "/browser_page.py",
        "/page.json?x",
    ],
)
def test_other_paths_are_not_there(server: ScanServer, path: str) -> None:
    assert status(server, path) == 404


def test_only_this_computer_under_its_own_name_is_answered(server: ScanServer) -> None:
    port = server.address.split(":")[-1].strip("/")
    assert status(server, "/page.json", Host=f"localhost:{port}") == 200
    for host in ("evil.example", f"evil.example:{port}", "127.0.0.1", f"127.0.0.1:{port}.evil.example", ""):
        assert status(server, "/page.json", Host=host) == 403
    assert status(server, "/page.json", "POST") == 501
    with urllib.request.urlopen(server.address, timeout=60) as answer:
        assert "default-src 'self'" in answer.headers["Content-Security-Policy"]
        assert "Access-Control-Allow-Origin" not in answer.headers


def test_a_turned_sensor_is_drawn_level_and_saved_in_its_own_frame(tmp_path: Path) -> None:
    turned = np.column_stack([-POINTS[:, 1], POINTS[:, 0], POINTS[:, 2:]])
    np.save(tmp_path / "turned.npy", turned)
    with serving([tmp_path / "turned.npy"], around=False, reading=ScanSettings(axes="y-forward")) as server:
        points = np.frombuffer(get(server, "scans/0.bin"), "<f4").reshape(-1, 4)
        found = json.loads(get(server, "scans/0.json"))
    np.testing.assert_array_equal(points, POINTS)
    mounting = Mounting(axes="y-forward")
    expected = Detector(SMALL.bundle, threads=1, mounting=mounting, score_threshold=0.1)(turned)
    assert found["save"]["boxes"] == expected.to_dicts() and len(expected) > 3
    for shown, own in zip(found["detections"], expected.boxes, strict=True):
        np.testing.assert_allclose(shown["box"][:2], [own[1], -own[0]], atol=1e-5)


def test_what_cannot_be_shown_is_one_line(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ScanError, match=r"2\.bin: file size \(5 bytes"):
        ScanServer([folder / "2.bin"], options=SMALL)
    (tmp_path / "drive.mcap").write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(ConfigError, match=r"drive\.mcap: is a recording; look at it with asca detect --rerun"):
        ScanServer([tmp_path / "drive.mcap"], options=SMALL)
    other = socket.create_server(("127.0.0.1", 0))
    with other, pytest.raises(ConfigError, match=r"--port \d+: .* leave it out"):
        ScanServer([folder / "1.bin"], other.getsockname()[1], options=SMALL)


def test_the_command_ends_on_ctrl_c_without_a_traceback(folder: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "asca_pillars.cli",
        "view",
        str(folder / "1.bin"),
        "--ahead",
        "--no-browser",
        "--threads",
        "1",
    ]
    restored = partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, preexec_fn=restored)
    try:
        assert process.stdout is not None
        output = process.stdout.readline()
        address = next(word for word in output.split() if word.startswith("http://127.0.0.1:"))
        with urllib.request.urlopen(address + "scans/0.json", timeout=60) as answer:
            assert len(json.load(answer)["detections"]) > 3
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=10)
    finally:
        process.kill()
    assert process.returncode == 0 and errors == ""


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_the_browser_shows_them(server: ScanServer, tmp_path: Path) -> None:
    with open_tab(tmp_path / "profile") as tab:
        tab.call("Page.navigate", url=server.address)
        saved = finished(tab, server_scan(server, 0))
        page, found = json.loads(get(server, "page.json")), json.loads(get(server, "scans/0.json"))
        assert saved["boxes"] == shown(page, found)
        assert tab.evaluate("getComputedStyle(document.querySelector('label.button')).display") == "none"
        cars = sum(box["class"] == "Car" for box in saved["boxes"])
        assert_drawn(tab, tmp_path / "view.png", cars)
        move_slider(tab, "Car", 0.1)
        scores = {"Car": 0.1, "Pedestrian": page["classes"][1]["score"], "Cyclist": page["classes"][2]["score"]}
        more = finished(tab, server_scan(server, 0))["boxes"]
        assert more == [one for one in found["save"]["boxes"] if one["score"] >= scores[one["class"]]]
        assert len(more) > len(saved["boxes"])
        arrow = "document.dispatchEvent(new KeyboardEvent('keydown', { key: 'ArrowRight' }))"
        tab.evaluate(arrow)
        assert "2.bin: file size (5 bytes)" in failure(tab)
        tab.evaluate(arrow)
        finished(tab, server_scan(server, 2))


def server_scan(server: ScanServer, number: int) -> str:
    """The path of a scan, as the server says it."""
    return str(json.loads(get(server, f"scans/{number}.json"))["save"]["scan"])
