"""The page in a browser, from a plain file server and without a network: it finds the boxes that Python finds."""

import json
import os
import re
import shutil
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from asca_deploy import Detector, sample_scan_path, shipped_bundles
from asca_deploy.browser_page import ORT_FILES, ORT_LICENSE, ORT_NOTICES, find_ort_web, page_zip, write_page
from asca_deploy.golden import golden_stages
from asca_deploy.manifest import load_pillar_bundle
from asca_deploy.pillar.pipeline import PillarPipeline
from asca_pillars.base.errors import BundleError, ConfigError, OutputError
from asca_pillars.cli.main import app
from asca_pillars.ops.pillar.prepare import PillarCounts
from asca_pillars.pictures.colors import HEIGHT_RAMP, HEIGHT_SPAN_M, class_rgb
from asca_pillars.scans.ground_height import measured_mounting
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_reader import read_scan, write_scan
from tests.deploy.chromium import CHROMIUM, Tab, file_server, open_tab
from tests.deploy.page_driver import assert_drawn, failure, finished, move_slider, status
from tests.helpers.bundles import DENSE_FLOAT32, DENSE_INT8

ORT_WEB = os.environ.get("ASCA_ORT_WEB")
"""npm's package onnxruntime-web, a .tgz or its folder."""
NEAR_M = 0.02
SCORE_TOLERANCE = 0.02

MODELS = shipped_bundles() | {folder.name: folder for folder in (DENSE_FLOAT32, DENSE_INT8)}

needs_ort_web = pytest.mark.skipif(not ORT_WEB, reason="needs ASCA_ORT_WEB, a .tgz of `npm pack onnxruntime-web`")
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    with open_tab(tmp_path_factory.mktemp("profile")) as tab:
        yield tab


@pytest.fixture
def made_up_package(tmp_path: Path) -> Path:
    """A folder that looks like npm's package."""
    folder = tmp_path / "onnxruntime-web"
    (folder / "dist").mkdir(parents=True)
    (folder / "package.json").write_text('{"name": "onnxruntime-web", "version": "9.9.9"}')
    for name in ORT_FILES:
        (folder / "dist" / name).write_bytes(b"code")
    return folder


@needs_ort_web
@needs_chromium
@pytest.mark.parametrize("name", ["dense_float32", "dense_int8", "default_float32", "default"])
def test_the_browser_finds_the_boxes_that_python_finds(name: str, tmp_path: Path, tab: Tab) -> None:
    page = tmp_path / "page"
    bundle = MODELS[name]
    write_page(page, bundle, sample_scan_path(), find_ort_web(Path(str(ORT_WEB))))
    points = read_scan(sample_scan_path()).points
    write_scan(tmp_path / "half.bin", points[::2])
    write_scan(tmp_path / "ahead.bin", points[points[:, 0] > np.abs(points[:, 1])])
    write_scan(tmp_path / "outside.bin", points[:9] + np.array([500, 0, 0, 0], np.float32))
    detector = Detector(bundle, threads=1)
    with file_server(page) as address:
        tab.call("Page.navigate", url=address)
        finished(tab, "sample.bin")
        set_sensor(tab)
        assert_same(finished(tab, "sample.bin"), detector, points)
        assert_drawn(tab, tmp_path / "page.png", list(detector(points).names).count("Car"))
        for score in (0.2, 0.9, detector.spec.classes[0].score_threshold):
            move_slider(tab, "Car", score)
            moved = {"Car": score}
            expected = Detector(bundle, threads=1, score_threshold=moved)
            assert_same(finished(tab, "sample.bin"), expected, points, least=0)
        tab.evaluate("document.getElementById('again').click()")
        warm = finished(tab, "sample.bin")
        tab.choose_file("#file", tmp_path / "half.bin")
        half = finished(tab, "half.bin")
        assert_same(half, detector, points[::2])
        assert "49% of the points lie behind the sensor" in warm["warnings"][0] and "look all around" in status(tab)
        tab.choose_file("#file", tmp_path / "ahead.bin")
        assert finished(tab, "ahead.bin")["warnings"] == [] and "look all around" not in status(tab)
        tab.choose_file("#file", tmp_path / "outside.bin")
        nothing = finished(tab, "outside.bin")
        assert (nothing["pillars"], nothing["boxes"]) == (0, [])
        tab.choose_file("#file", tmp_path / "half.bin", tmp_path / "ahead.bin")  # the first by name, then the other
        finished(tab, "ahead.bin")
        tab.evaluate("document.dispatchEvent(new KeyboardEvent('keydown', { key: 'ArrowRight' }))")
        finished(tab, "half.bin")
        assert tab.evaluate("document.getElementById('place').textContent").startswith("2 of 2")
        np.save(tmp_path / "array.npy", points[::2])
        tab.choose_file("#file", tmp_path / "array.npy")
        assert finished(tab, "array.npy")["boxes"] == half["boxes"]
        tab.choose_file("#file", page / "bundle.json")
        assert "scans are .bin, .npy, .pcd and .ply files" in failure(tab)
    print(f"{name} in {CHROMIUM}: {sum(warm['times_ms'].values()):.0f} ms per scan", warm["times_ms"])


@needs_ort_web
@needs_chromium
@pytest.mark.parametrize(("name", "passes"), [("dense_float32", 4), ("default_float32", 1)])
def test_the_browser_looks_around_and_takes_a_mounting_as_python_does(
    name: str, passes: int, tmp_path: Path, tab: Tab
) -> None:
    page = tmp_path / "page"
    bundle = MODELS[name]
    write_page(page, bundle, sample_scan_path(), find_ort_web(Path(str(ORT_WEB))))
    points = read_scan(sample_scan_path()).points
    turned = Mounting(axes="-x,-y,z").level.inverse.points(points)
    raised = turned - np.array([0, 0, 0.4, 0], np.float32)
    write_scan(tmp_path / "raised.bin", raised)
    with file_server(page) as address:
        tab.call("Page.navigate", url=address)
        by_itself = finished(tab, "sample.bin")
        assert by_itself["passes"] == passes and "49% of the points lie behind the sensor: looked at all" in status(tab)
        set_sensor(tab)
        ahead = finished(tab, "sample.bin")
        set_sensor(tab, around=True)
        around = Detector(bundle, threads=1, view="around")
        saved = finished(tab, "sample.bin")
        assert saved["boxes"] == by_itself["boxes"]
        assert_same(saved, around, points, least=len(ahead["boxes"]) + 4)
        assert (saved["passes"], saved["warnings"]) == (passes, []) and ("in 4 passes" in status(tab)) == (passes == 4)
        low = {"Car": 0.15, "Pedestrian": 0.2}
        for class_, score in low.items():
            move_slider(tab, class_, score)
        lower = Detector(bundle, threads=1, view="around", score_threshold=low)
        assert_same(finished(tab, "sample.bin"), lower, points)
        for class_ in low:
            move_slider(tab, class_, next(c.score_threshold for c in around.spec.classes if c.name == class_))
        set_sensor(tab, around=False, axes="-x,-y,z", height="2.2")
        finished(tab, "sample.bin")
        tab.choose_file("#file", tmp_path / "raised.bin")
        mounting = Mounting(axes="-x,-y,z", sensor_height_m=2.2)
        assert_same(finished(tab, "raised.bin"), Detector(bundle, threads=1, mounting=mounting), raised)
        set_sensor(tab, axes="-x,-y,z", height="auto")
        measured, estimate = measured_mounting([raised], mounting)
        saved = finished(tab, "raised.bin")
        assert_same(saved, Detector(bundle, threads=1, mounting=measured), raised)
        assert f"{estimate.height_m:.2f} m above the ground" in saved["warnings"][-1]
        set_sensor(tab, axes="-x,-y,z", height="auto", around=True)
        assert_same(finished(tab, "raised.bin"), Detector(bundle, threads=1, mounting=measured, view="around"), raised)
        set_sensor(tab, axes="up")
        assert "axes up: give x-forward, y-forward or" in failure(tab)
        set_sensor(tab)
        finished(tab, "raised.bin")


@needs_ort_web
@needs_chromium
def test_the_browser_looks_around_in_one_pass_where_python_does(tmp_path: Path, tab: Tab) -> None:
    page, bundle = tmp_path / "page", tmp_path / "bundle"
    shutil.copytree(shipped_bundles()["fast"], bundle)
    described = json.loads((bundle / "bundle.json").read_text())
    described["expected_input"]["camera_view"] = False  # as if it were trained on whole revolutions
    (bundle / "bundle.json").write_text(json.dumps(described))
    write_page(page, bundle, sample_scan_path(), find_ort_web(Path(str(ORT_WEB))))
    with file_server(page) as address:
        tab.call("Page.navigate", url=address)
        finished(tab, "sample.bin")
        set_sensor(tab)
        ahead = finished(tab, "sample.bin")
        for around in (True, False):
            set_sensor(tab, around=around)
            saved = finished(tab, "sample.bin")
            detector = Detector(bundle, threads=1, view="around" if around else "ahead")
            assert_same(saved, detector, read_scan(sample_scan_path()).points)
            assert saved["passes"] == 1 and (saved["pillars"] > 1.5 * ahead["pillars"]) == around


def set_sensor(tab: Tab, *, around: bool = False, axes: str = "", height: str = "") -> None:
    fields = f"around.value = {'around' if around else 'ahead'!r}; axes.value = {axes!r}; height.value = {height!r}"
    names = "[around, axes, height] = ['around', 'axes', 'height'].map((id) => document.getElementById(id))"
    tab.evaluate(f"(() => {{ const {names}; {fields}; sensor.dispatchEvent(new Event('change')); }})()")


def assert_same(saved: Any, detector: Detector, points: NDArray[np.float32], least: int = 4) -> None:
    in_turn = [box["score"] for box in saved["boxes"]]
    assert in_turn == sorted(in_turn, reverse=True)
    expected = detector(points)
    assert len(expected) >= least
    # By class and distance: of boxes whose scores tie a rounding decides which comes first.
    expected = expected[np.lexsort((expected.boxes[:, 0], np.array(expected.names)))]
    boxes = sorted(saved["boxes"], key=lambda box: (box["class"], box["x_m"]))
    assert [box["class"] for box in boxes] == list(expected.names)
    centers = np.array([[box["x_m"], box["y_m"], box["z_m"]] for box in boxes])
    scores = np.array([box["score"] for box in boxes])
    np.testing.assert_allclose(scores, expected.scores, atol=SCORE_TOLERANCE)
    far = np.linalg.norm(centers - expected.boxes[:, :3], axis=1) >= NEAR_M
    if detector.bundle.precision == "int8":
        # A rounding can decide between two candidates of one object whose scores tie; Python has both.
        assert far.sum() <= 1
        assert isinstance(detector.pipeline, PillarPipeline)
        candidates = golden_stages(detector.pipeline, points)["decode"]
        distances = np.linalg.norm(centers[far, None] - candidates["boxes"][:, :3], axis=2)
        tied = np.abs(candidates["scores"] - expected.scores[far, None]) < SCORE_TOLERANCE
        far[far] = ~((distances < NEAR_M) & tied).any(axis=1)
    assert not far.any()
    assert isinstance(expected.report.counts, PillarCounts)
    # The turned passes follow the ground, whose plane is found by other draws.
    assert saved["pillars"] == pytest.approx(expected.report.counts.pillars, rel=0 if detector.passes == 1 else 0.002)


def test_the_page_holds_what_it_needs_and_names_it(made_up_package: Path, tmp_path: Path) -> None:
    page, bundle = tmp_path / "page", shipped_bundles()["default"]
    options = ["--browser", "-o", str(page), "--ort-web", str(made_up_package)]
    for _ in range(2):  # and may be written again
        result = CliRunner().invoke(app, ["export", bundle.name, *options])
        assert result.exit_code == 0, result.output
    assert f"python -m http.server --directory {page}" in " ".join(result.output.split())
    contents = json.loads((page / "page.json").read_text())
    assert contents["colors"] == {name: list(class_rgb(name)) for name in ("Car", "Pedestrian", "Cyclist")}
    assert contents["heights"] == {"ramp": [list(color) for color in HEIGHT_RAMP], "span_m": HEIGHT_SPAN_M}
    assert contents["onnxruntime_web"] == "9.9.9" and contents["bundle"] == bundle.name
    files = {path.name: path for path in page.iterdir()}
    assert {*contents["files"], "page.json"} == set(files)
    assert files["sample.bin"].read_bytes() == sample_scan_path().read_bytes()
    for path in bundle.iterdir():
        assert files[path.name].read_bytes() == path.read_bytes()
    for name, path in files.items():  # what a module or the page loads lies beside it
        if name.endswith((".js", ".html")):
            text = path.read_text()
            loaded = re.findall(r'"([^" ]+\.(?:js|mjs|css|wasm))"', text)
            assert {Path(word).name for word in loaded} <= set(files), name
            assert "://" not in text, f"{name} loads something from elsewhere"


def test_the_zip_is_the_page_with_the_license_of_its_runtime(made_up_package: Path, tmp_path: Path) -> None:
    page, bundle = tmp_path / "page", DENSE_INT8
    write_page(page, bundle, sample_scan_path(), made_up_package)
    first = page_zip(page).read_bytes()
    write_page(page, bundle, sample_scan_path(), made_up_package)
    assert page_zip(page) == tmp_path / "page.zip" and page_zip(page).read_bytes() == first
    with zipfile.ZipFile(page_zip(page)) as archive:
        assert archive.testzip() is None
        held = {name: archive.read(name) for name in archive.namelist()}
    assert held == {f"page/{path.name}": path.read_bytes() for path in page.iterdir()}
    assert b"Copyright (c) Microsoft Corporation" in held[f"page/{ORT_LICENSE}"]
    assert len(held[f"page/{ORT_NOTICES}"]) > 1000


@pytest.mark.parametrize("name", ["index.html", "main.js", "page.json", "sample.bin", "évil .mjs"])
def test_a_stranger_s_names_of_graphs_do_not_reach_the_page(made_up_package: Path, tmp_path: Path, name: str) -> None:
    """Bytes of a graph may well be a script, and a page would run it."""
    bundle, page = tmp_path / "bundle", tmp_path / "page"
    shutil.copytree(DENSE_INT8, bundle)
    described = json.loads((bundle / "bundle.json").read_text())
    (bundle / "backbone.onnx").rename(bundle / name)
    described["graphs"]["backbone"]["file"] = name
    (bundle / "bundle.json").write_text(json.dumps(described))
    write_page(page, bundle, sample_scan_path(), made_up_package)
    write_page(tmp_path / "usual", DENSE_INT8, sample_scan_path(), made_up_package)
    usual = {path.name: path.read_bytes() for path in (tmp_path / "usual").iterdir()}
    assert {path.name: path.read_bytes() for path in page.iterdir()} == usual


def test_what_is_read_and_what_others_wrote_is_not_replaced(made_up_package: Path, tmp_path: Path) -> None:
    """A page is a bundle, too."""
    page, bundle, zipped = tmp_path / "page", DENSE_INT8, tmp_path / "page.zip"
    with zipfile.ZipFile(zipped, "w") as archive:
        archive.writestr("page/page.json", "{}")
    for content in (zipped.read_bytes(), b"precious"):
        zipped.write_bytes(content)
        with pytest.raises(OutputError, match=r"page\.zip: `asca export --browser` did not write it"):
            write_page(page, bundle, sample_scan_path(), made_up_package)
        assert zipped.read_bytes() == content and not page.exists()
    zipped.unlink()
    write_page(page, bundle, sample_scan_path(), made_up_package)
    before = {path.name: path.read_bytes() for path in page.iterdir()}
    for read in ((page, sample_scan_path()), (bundle, page / "sample.bin")):
        with pytest.raises(OutputError, match=r"would replace the input "):
            write_page(page, *read, made_up_package)
    (page / "page.json").write_text('{"files": ["index.html"]}')
    with pytest.raises(OutputError, match=r"page\.json: `asca export --browser` did not write it"):
        write_page(page, bundle, sample_scan_path(), made_up_package)
    assert {path.name for path in page.iterdir()} == set(before)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("precious")
    with pytest.raises(OutputError, match=r"thesis\.txt"):
        write_page(tmp_path / "mine", bundle, sample_scan_path(), made_up_package)


def test_a_package_that_is_none(made_up_package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bundle = DENSE_INT8
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="not in this folder; get it with `npm pack onnxruntime-web@"):
        find_ort_web(None)
    with pytest.raises(ConfigError, match=r"gone\.tgz: no such file"):
        find_ort_web(Path("gone.tgz"))
    (made_up_package / "package.json").write_text('{"name": "other", "version": "1"}')
    (tmp_path / "torn.tgz").write_bytes(b"torn")
    for package, message in ((made_up_package, "npm's package other"), (tmp_path / "torn.tgz", "is not npm's package")):
        with pytest.raises(ConfigError, match=message):
            write_page(tmp_path / "page", bundle, sample_scan_path(), package)
    assert not (tmp_path / "page").exists()


def test_a_bundle_that_the_page_cannot_run(made_up_package: Path, tmp_path: Path, monkeypatch) -> None:
    bundle = load_pillar_bundle(shipped_bundles()["default"])
    pooled = replace(bundle.spec, grid=replace(bundle.spec.grid, zones=3, map="pooled"))
    monkeypatch.setattr("asca_deploy.browser_page.load_pillar_bundle", lambda _: replace(bundle, spec=pooled))
    with pytest.raises(BundleError, match="kind pillar, pooled map; the page runs"):
        write_page(tmp_path / "page", tmp_path, sample_scan_path(), made_up_package)
    with pytest.raises(BundleError, match="kind pillar_refine, warped map; the page runs"):
        monkeypatch.undo()
        write_page(tmp_path / "page", shipped_bundles()["accurate"], sample_scan_path(), made_up_package)
