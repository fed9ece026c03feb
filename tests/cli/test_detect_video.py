"""`asca detect --video`, and the page of pictures: what is written, and what is refused before the work."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from asca_deploy import result_files
from asca_deploy.recordings import video as recording_video
from asca_deploy.recordings.video import recording_rate_hz, require_video
from asca_pillars.base.errors import AscaError, ConfigError, OutputError
from asca_pillars.cli.detect import detect
from asca_pillars.pictures.video import is_own_video
from asca_pillars.scans.scan_reader import write_scan
from tests.cli.short_drive import POINTS, SCANS
from tests.helpers.gallery_cards import cards, sources, title
from tests.helpers.video_encoder import needs_encoder


def frames(path: Path) -> list[np.ndarray]:
    read = cv2.VideoCapture(str(path))
    return [read.read()[1] for _ in range(int(read.get(cv2.CAP_PROP_FRAME_COUNT)))]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for number in range(3):
        write_scan(tmp_path / "scans" / f"{number}.bin", POINTS - np.array([number, 0, 0, 0], np.float32))
    return tmp_path / "scans"


@needs_encoder
def test_scans_of_a_folder_become_a_video(folder: Path, tmp_path: Path) -> None:
    for view in ("above", "chase"):  # and the second replaces the first
        detect([folder], out=tmp_path / "out", threads=1, pictures=False, video=tmp_path / "a.mp4", video_view=view)
        assert is_own_video(tmp_path / "a.mp4") and len(frames(tmp_path / "a.mp4")) == 3
    assert not (tmp_path / "out" / "index.html").exists()


@needs_encoder
def test_a_recording_becomes_a_video_of_tracks(drive: Path, tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")
    detect([drive], out=tmp_path / "out", threads=1, track=True, video=tmp_path / "a.mp4")
    images = frames(tmp_path / "a.mp4")
    assert len(images) == SCANS
    assert np.abs(images[0].astype(int) - images[-1]).mean() > 0.5
    assert not (tmp_path / "out" / "index.html").exists()


def test_what_cannot_be_a_video_is_refused_before_the_work(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording_video, "find_encoder", lambda: "ffmpeg")
    (tmp_path / "mine.mp4").write_bytes(b"\0\0\0\x20ftypisom of mine")
    cases: list[tuple[dict[str, Any], type[AscaError], str]] = [
        ({"video": tmp_path / "mine.mp4"}, OutputError, "mine.mp4: `asca detect` did not write it"),
        ({"video": tmp_path / "a.avi"}, ConfigError, "viewers open .mp4 files"),
        ({"video_view": "chase"}, ConfigError, "--video-view chase: is of a video; give --video FILE.mp4, too"),
        ({"video": tmp_path / "a.mp4", "video_view": "side"}, ConfigError, "--video-view side: give above or chase"),
        ({"video": tmp_path / "a.mp4", "cluster": "local"}, ConfigError, "is not made with --cluster"),
    ]
    for options, kind, message in cases:
        with pytest.raises(kind, match=message):
            detect([folder], out=tmp_path / "out", threads=1, **options)
    assert not (tmp_path / "out").exists()
    monkeypatch.undo()
    require_video(None, "above", [])


def test_a_video_runs_as_fast_as_its_recording() -> None:
    regular = np.arange(10) * 50_000_000
    assert recording_rate_hz(regular.tolist()) == pytest.approx(20)
    assert recording_rate_hz([*regular.tolist(), 10**18]) == pytest.approx(20)
    assert recording_rate_hz([5, 5]) == recording_rate_hz([]) == 10


def test_a_page_shows_the_pictures_of_a_run(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    detect([folder], out=out, threads=1)
    page = (out / "index.html").read_text()
    assert title(out / "index.html") == "asca detect: 3 scans"
    assert list(cards(page)) == ["0", "1", "2"]
    assert all(one.keys() == {"boxes", "best score", "lowest score"} for one in cards(page).values())
    assert all((out / source).is_file() for source in sources(page))
    detect([folder], out=out, threads=1, pictures=False)
    assert (out / "index.html").read_text() == page, "its pictures are of the same boxes"
    detect([folder], out=out, threads=1, pictures=False, score=["0.9"])
    assert not (out / "index.html").exists(), "its pictures are gone"
    (out / "index.html").write_text("<h1>mine</h1>")
    with pytest.raises(OutputError, match=r"index\.html: `asca detect` did not write it"):
        detect([folder], out=out, threads=1)


def test_misses_are_counted_where_there_are_labels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One label on a car that is found, one where nothing is, one behind the sensor."""
    write_scan(tmp_path / "scans" / "0.bin", POINTS)
    detect([tmp_path / "scans"], out=tmp_path / "out", threads=1, pictures=False)
    found = json.loads((tmp_path / "out" / "0.json").read_text())["boxes"][0]
    keys = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad")
    labels = np.array([[found[key] for key in keys]] * 3, np.float32)
    labels[1:, :2] = (40, 25), (-20, 0)
    monkeypatch.setattr(result_files, "labels_of_scan", lambda path: labels)
    detect([tmp_path / "scans"], out=tmp_path / "out", threads=1)
    (values,) = cards((tmp_path / "out" / "index.html").read_text()).values()
    assert values["missed"] == 1
