"""The page's JavaScript in node: its stages on golden vectors, overlaps and readers against Python's."""

import base64
import json
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_deploy import sample_scan_path, shipped_bundles
from asca_deploy.around import about_ground, merge, turns_around, widen_ranges, without_own_vehicle
from asca_deploy.bundle import PillarBundle
from asca_deploy.golden import write_golden
from asca_deploy.manifest import load_pillar_bundle
from asca_pillars.base.errors import AscaError, ScanError
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.boxes import Ranges, wrap_angle
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.geometry.overlap import bev_iou
from asca_pillars.pictures.colors import ground_height
from asca_pillars.scans.ground_height import estimate_height, fit_ground_plane
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_reader import read_scan, write_scan
from benchmarks.fuzz import damaged
from benchmarks.fuzz_inputs import Kind, read_points, scan_seeds
from tests.deploy import conftest as tiny
from tests.helpers.bundles import DENSE_FLOAT32, DENSE_INT8
from tests.scans import scan_files
from tests.scans.pcd_cases import CASES, LZF_STREAMS

ROOT = Path(__file__).parents[2]
MODULES = ROOT / "deploy" / "asca_deploy" / "browser"
SCRIPTS = Path(__file__).parent / "javascript"
NODE = shutil.which("node")
MODELS = shipped_bundles()["default_float32"], shipped_bundles()["default"], DENSE_FLOAT32, DENSE_INT8

pytestmark = pytest.mark.skipif(NODE is None, reason="needs node")


def node(*arguments: str | Path, given: str = "") -> Any:
    command = [str(NODE), *map(str, arguments)]
    result = subprocess.run(command, input=given, capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def call(module: str, function: str, *calls: list[Any]) -> list[dict[str, Any]]:
    """What a function of a module answers to each of some lists of arguments: its result, or its error."""
    return node(SCRIPTS / "call.mjs", MODULES / module, function, given=json.dumps(calls, default=_bytes))


def _bytes(value: bytes) -> dict[str, str]:
    return {"base64": base64.b64encode(value).decode("ascii")}


def float32(points: NDArray[np.float32]) -> dict[str, str]:
    """Points as `call.mjs` takes them for a Float32Array."""
    return {"float32": _bytes(points.tobytes())["base64"]}


def test_stages_on_the_golden_vectors_of_the_models_that_ship(tmp_path: Path) -> None:
    write_scan(tmp_path / "scan.bin", read_scan(sample_scan_path()).points[::3])
    for folder in MODELS:
        write_golden(tmp_path / folder.name, folder, tmp_path / "scan.bin")
        assert_same_stages(tmp_path / folder.name, folder)


def test_stages_on_a_grid_of_three_zones_beyond_both_limits(any_bundle: Path, tmp_path: Path) -> None:
    write_scan(tmp_path / "scan.bin", tiny.make_scan(3, 6000))
    stages = write_golden(tmp_path / "golden", any_bundle, tmp_path / "scan.bin")
    limits, pillars = tiny.SPEC.limits, stages["pillarize"]
    assert len(pillars["cells"]) == limits.max_pillars and pillars["point_counts"].max() == limits.max_points
    assert len(stages["suppress"]["boxes"]) > 2
    assert_same_stages(tmp_path / "golden", any_bundle)


def assert_same_stages(golden: Path, bundle: Path) -> None:
    differences = node(SCRIPTS / "golden.mjs", MODULES, golden, bundle)
    for name, difference in differences.items():
        # Boxes are computed in float64 on both sides; exp and the like may differ in the last digit.
        assert float(difference) <= (1e-5 if name.endswith((".boxes", ".scores")) else 0), (name, difference)
    compared = {"dense": 12, "sub": 11 + 3 * len(("strided", "same", "places"))}
    compared["fine"] = compared["sub"] + 1  # first_0
    assert len(differences) == compared[load_pillar_bundle(bundle).pillar.active_cells or "dense"]


def test_overlaps_of_random_boxes() -> None:
    rng = np.random.default_rng(4)
    boxes = np.column_stack([rng.uniform(-4, 4, (200, 3)), rng.uniform(0.4, 5, (200, 3)), rng.uniform(-4, 4, 200)])
    boxes[1::10] = boxes[::10]  # the same box
    boxes[2::10, 6] = boxes[::10, 6] + np.pi / 2
    expected = bev_iou(boxes, boxes)
    pairs = [[boxes[i].tolist(), boxes[j].tolist()] for i in range(0, 200, 5) for j in range(200)]
    found = [answer["result"] for answer in call("boxes.js", "bevIou", *pairs)]
    np.testing.assert_allclose(found, expected[::5].reshape(-1), atol=1e-9)
    assert np.count_nonzero(expected[::5]) > 1000


def test_a_revolution_lies_behind_the_sensor_too() -> None:
    points = read_scan(sample_scan_path()).points[::40]
    ranges = [[0, 69.12], [-30.72, 30.72], [-3, 1]]
    ahead = points[points[:, 0] > 0]
    every_way = [[-50, 50], *ranges[1:]]
    cases = [(ranges, points), (ranges, ahead), (every_way, points), (ranges, points[:0])]
    found = call("grid.js", "percentBehind", *([{"ranges": own}, scan.reshape(-1).tolist()] for own, scan in cases))
    cut, *fine = (answer["result"] for answer in found)
    assert cut == 49 and fine == [0, 0, 0]


def test_a_mounting_moves_points_and_boxes_as_python_does() -> None:
    named = "x-forward", "y-forward", "-y,x,z", " -x, -y,+z", "x,-y,-z", "x,-y,z"
    changes = [Mounting(axes=axes).level for axes in named]
    for level, answer in zip(changes, call("frames.js", "levelFrame", *([axes] for axes in named)), strict=True):
        assert np.array_equal(answer["result"]["axes"], level.axes) and answer["result"]["shift"] == [0, 0, 0]
    assert_moves_alike(changes, tiny.make_scan(count=50))


def test_a_turn_about_a_sloping_ground_moves_points_and_boxes_as_python_does() -> None:
    scan = read_scan(sample_scan_path()).points
    ranges = Ranges((0.0, 69.12), (-30.72, 30.72), (-3.0, 1.0))
    turns = about_ground(turns_around(ranges, camera_view=True), scan)
    assert_moves_alike(turns, scan[:50])
    grid = {"x_range_m": ranges.x_m, "y_range_m": ranges.y_m}
    plain = call("around.js", "turnsAround", [grid, True])[0]["result"]
    answers = call("around.js", "aboutGround", [plain, float32(scan)], [plain, float32(scan[:9])])
    for answer, expected in zip(answers, (turns, turns_around(ranges, camera_view=True)), strict=True):
        for one, turn in zip(answer["result"], expected, strict=True):
            np.testing.assert_allclose(one["axes"], turn.axes, atol=2e-4)  # other draws, the same plane


def assert_moves_alike(changes: Sequence[FrameChange], points: NDArray[np.float32]) -> None:
    boxes = np.random.default_rng(1).uniform(-3, 3, (20, 7))
    given = [{"axes": change.axes.tolist(), "shift": change.shift_m.tolist()} for change in changes]
    answers = call("frames.js", "changePoints", *([one, float32(points)] for one in given))
    for change, answer in zip(changes, answers, strict=True):
        np.testing.assert_array_equal(np.array(answer["result"], np.float32).reshape(-1, 4), change.points(points))
    answers = call("frames.js", "changeBox", *([one, box] for one in given for box in boxes.tolist()))
    found, expected = np.array([one["result"] for one in answers]), np.concatenate([c.boxes(boxes) for c in changes])
    np.testing.assert_allclose(found[:, :6], expected[:, :6], atol=1e-6)
    np.testing.assert_allclose(wrap_angle(found[:, 6] - expected[:, 6]), 0, atol=1e-6)


def test_axes_and_heights_that_python_refuses() -> None:
    axes = "", "x,y", "x,x,z", "z,y,x", "up", "x,y,--z", "X-forward", "x;y;z"
    for text, answer in zip(axes, call("frames.js", "levelFrame", *([text] for text in axes)), strict=True):
        assert answer["error"].startswith(f"axes {text}: ")
        with pytest.raises(AscaError):
            _ = Mounting(axes=text).level
    heights = "high", "11", "-10.5", "nan", "1e9", "1,8", "0x1"
    for text, answer in zip(
        heights, call("ground.js", "sensorHeight", *([h, float32(tiny.make_scan())] for h in heights)), strict=True
    ):
        assert answer["error"].startswith(f"sensor height {text}: give metres")
    (unclear, plain, none) = call(
        "ground.js", "sensorHeight", *([h, float32(tiny.make_scan()[:9])] for h in ("auto", "1.8", ""))
    )
    assert unclear["error"].startswith("the sensor's height cannot be estimated: too few points")
    assert plain == {"result": 1.8} and none == {}


def test_the_ground_and_the_height_above_it_are_those_of_python() -> None:
    scan = read_scan(sample_scan_path()).points[::2]
    rng = np.random.default_rng(0)
    sloping = rng.uniform(-25, 25, (20_000, 4)).astype(np.float32)
    sloping[:, 2] = 0.02 * sloping[:, 0] - 1.4 + rng.normal(0, 0.02, len(sloping))
    steep, cloud = sloping * np.array([1, 1, 8, 1], np.float32), rng.uniform(-20, 20, (20_000, 4)).astype(np.float32)
    scans = [scan, sloping, steep, cloud]
    for points, answer in zip(scans, call("ground.js", "groundPlane", *([float32(p)] for p in scans)), strict=True):
        expected, found = fit_ground_plane(points), answer["result"]
        assert expected is not None
        assert ("doubt" in found) == (expected.doubt is not None)
        if expected.doubt is None:
            assert found["height"] == pytest.approx(expected.height_m, abs=0.01)
            np.testing.assert_allclose(found["normal"], expected.normal, atol=2e-4)
    (height,) = call("ground.js", "sensorHeight", ["auto", float32(scan)])
    assert height["result"] == pytest.approx(estimate_height([scan]).height_m, abs=0.01)


@pytest.mark.parametrize("camera_view", [True, False])
def test_as_many_passes_or_as_wide_ranges_as_python_takes(camera_view: bool) -> None:
    grids = [((0.0, 69.12), (-30.72, 30.72)), ((-51.2, 51.2), (-51.2, 51.2)), ((0.0, 40.0), (-40.0, 40.0))]
    grids += [((-20.0, 60.0), (-40.0, 40.0)), ((2.0, 40.0), (-10.0, 40.0)), ((0.0, 9.0), (1.0, 9.0))]
    calls = [[{"x_range_m": x, "y_range_m": y}, camera_view] for x, y in grids]
    *answers, refused = call("around.js", "turnsAround", *calls)
    assert "error" in refused
    for (x, y), answer in zip(grids[:-1], answers, strict=True):
        expected = turns_around(Ranges(x, y, (-3.0, 1.0)), camera_view=camera_view)
        np.testing.assert_allclose([turn["axes"] for turn in answer["result"]], [t.axes for t in expected], atol=1e-12)
    manifests = [json.loads((folder / "bundle.json").read_text()) for folder in MODELS]
    for manifest in manifests:
        manifest["expected_input"]["camera_view"] = camera_view
    answers = call("around.js", "widenRanges", *([manifest] for manifest in manifests))
    for bundle, answer in zip(map(load_pillar_bundle, MODELS), answers, strict=True):
        found = answer["result"]
        looked = widen_ranges(replace(bundle, expected_input=replace(bundle.expected_input, camera_view=camera_view)))
        assert isinstance(looked, PillarBundle)
        limits, grid = looked.spec.limits, looked.spec.grid
        assert found["grid"] | {"x_range_m": [*grid.x_range_m], "y_range_m": [*grid.y_range_m]} == found["grid"]
        assert found["limits"]["max_pillars"] == limits.max_pillars
        assert (looked.spec == bundle.spec) == (camera_view or bundle.pillar.neck == "dense")


def test_a_box_around_the_sensor_is_left_out_as_by_python() -> None:
    rng = np.random.default_rng(4)
    drawn = np.column_stack([rng.uniform(-4, 4, (300, 3)), rng.uniform(1, 5, (300, 3)), rng.uniform(-3, 3, 300)])
    boxes = drawn.astype(np.float32)
    rest = without_own_vehicle(Detections(boxes, np.ones(300, np.float32), np.zeros(300, np.int64), ("Car",)))
    answer = call("around.js", "withoutOwnVehicle", [[{"box": box} for box in boxes.tolist()]])[0]["result"]
    assert 100 < len(rest) < 280
    np.testing.assert_array_equal(np.array([one["box"] for one in answer], np.float32), rest.boxes)


def test_boxes_of_several_passes_are_merged_as_by_python() -> None:
    rng = np.random.default_rng(3)
    turns = turns_around(Ranges((0.0, 69.12), (-30.72, 30.72), (-3.0, 1.0)), camera_view=True)
    passes, found = [], []
    for turn in turns:
        boxes = np.column_stack([rng.uniform(-12, 12, (60, 3)), rng.uniform(1, 5, (60, 3)), rng.uniform(-3, 3, 60)])
        one = Detections(
            boxes.astype(np.float32), rng.random(60).astype(np.float32), rng.integers(0, 2, 60), ("Car", "Van")
        )
        passes.append(one)
        off_ahead = np.abs(np.arctan2(one.boxes[:, 1], one.boxes[:, 0]))
        rows = zip(turn.inverse.boxes(one.boxes), one.scores, one.labels, off_ahead, strict=True)
        found += [
            {"box": box.tolist(), "score": float(score), "label": int(label), "offAhead": float(angle)}
            for box, score, label, angle in rows
        ]
    expected = merge(passes, turns, 0.1)
    answer = call("around.js", "merge", [found, {"passes": len(turns), "iou": 0.1}])[0]["result"]
    assert 10 < len(expected) < 100
    np.testing.assert_array_equal(np.array([one["box"] for one in answer], np.float32), expected.boxes)
    assert [one["label"] for one in answer] == expected.labels.tolist()


def test_the_ground_of_the_color_ramp_is_that_of_the_pictures() -> None:
    scans = [read_scan(sample_scan_path()).points[::40], tiny.make_scan(count=7), tiny.make_scan(count=7)[:0]]
    answers = call("scene.js", "groundHeight", *([scan.reshape(-1).tolist()] for scan in scans))
    for scan, answer in zip(scans, answers, strict=True):
        assert answer["result"] == pytest.approx(ground_height(scan[:, 2]), abs=1e-6)


def test_lzf_by_hand() -> None:
    answers = call("readers.js", "lzfDecompress", *([list(packed), len(expected)] for packed, expected in LZF_STREAMS))
    assert [bytes(answer["result"]) for answer in answers] == [expected for _, expected in LZF_STREAMS]


def test_files_at_the_edge_are_read_or_refused_as_by_python() -> None:
    answers = call("readers.js", "readScan", *(["a.pcd", case.content] for case in CASES))
    for case, answer in zip(CASES, answers, strict=True):
        assert ("result" in answer) == (case.points is not None), (case.name, answer)
        if case.points is not None:
            found = np.array(answer["result"]["points"], np.float32).reshape(-1, 4)
            np.testing.assert_array_equal(found, case.points, case.name)
            assert any("left out" in remark for remark in answer["result"]["remarks"]) == case.has_padding, case.name


def test_files_of_python_s_tests_are_read_or_refused_as_by_python(tmp_path: Path) -> None:
    """PCD, PLY and NumPy arrays of every encoding, byte order, type and layout, and .bin; damaged and empty ones."""
    scaled, none = scan_files.POINTS * np.array([1, 1, 1, 200], np.float32), scan_files.POINTS[:0]
    tables = [scan_files.POINTS, scaled, none, np.hstack([scaled, scaled]), scan_files.POINTS[:, :3], scaled[0]]
    types = "<f4", ">f4", "<f8", ">f8", "<f2", "u1", "i1", "<u2", ">i2", "<i4", "<i8", "c8", "?"
    arrays = [scan_files.npy(np.abs(table).astype(kind)) for table in tables for kind in types]
    arrays += [scan_files.npy(np.asfortranarray(tables[1])), scan_files.npy(np.zeros((4, 20), np.float32))]
    arrays += [arrays[0][:-1], arrays[0] + b"more", arrays[0].replace(b"(4, 4)", b"(4,-4)"), b"\x93NUMPY\x01\x00"]
    encodings = "ascii", "binary_little_endian", "binary_big_endian"
    kinds = "float", "uchar", "ushort"
    plain = [scan_files.ply(name, scaled, kind=kind) for name in encodings for kind in kinds]
    plys = [*plain, *(scan_files.ply(name, none) for name in encodings)]
    for content in (scan_files.ply(name) for name in encodings):
        plys += [content[:-1], content[:-60], content + b"1 2 3 4 5\n" * 9, b"\xef\xbb\xbf" + content, content[4:]]
        for change in (
            (b"property float z", b"property float w"),
            (b"element vertex", b"element points"),
            (b"element face", b"element vertex"),
            (b"uchar red", b"uchar x"),
            (b"float z", b"list uchar float z"),
            (b"double y", b"quad y"),
            (b"scalar_Intensity", b"gps_time"),
            (b" 1.0\n", b" 1.0\r\n"),
            (b"format ", b"fromat "),
        ):
            plys.append(content.replace(*change, 1))
    pcds = [b"nothing"]
    for content in (scan_files.pcd(name, scaled, kind="U1") for name in ("ascii", "binary", "binary_compressed")):
        pcds += [content, content[:-4], content.replace(b"intensity", b"scalar_Intensity")]
        for change in (
            (b"FIELDS _ x", b"FIELDS _ w"),
            (b"TYPE U F", b"TYPE U Q"),
            (b"WIDTH 4", b"WIDTH 6"),
            (b"HEIGHT 1", b"HEIGHT one"),
            (b"WIDTH 4\n", b""),
            (b"normal", b"x"),
            (b"7 7 7 1.5", b"7 7 seven 1.5"),
            (b"7 7 7 1.5", b"7 7 0x7 1.5"),
            *((b"7 7 7 1.5", b"7 7 7 " + word) for word in (b"nan", b"-inf", b"Infinity", b"1e2", b"+.5", b"3.")),
        ):
            pcds.append(content.replace(*change, 1))
    points = tiny.make_scan(count=400)
    rings = np.column_stack([points, np.arange(400) % 32]).astype("<f4")
    rings[:, 3] = np.ceil(rings[:, 3] * 255)
    points[3, 0], points[4, 3] = np.nan, 1.5
    bins = [points.tobytes(), rings[:399].tobytes(), (np.float32(0.1) * points).tobytes(), b"torn", b""]
    files = [("a.txt", pcds[1])]
    for name, contents in (("a.npy", arrays), ("a.ply", plys), ("a.pcd", pcds), ("a.bin", bins)):
        files += [(name, content) for content in contents]
    read = read_alike(tmp_path, files)
    assert len(files) - read > 50 and read > 80


@pytest.mark.parametrize("suffix", ["pcd", "bin", "ply", "npy"])
def test_damaged_files_are_read_or_refused_as_by_python(tmp_path: Path, suffix: str) -> None:
    """The inputs of the fuzz benchmark."""
    kind = Kind("scan", tmp_path / f"a.{suffix}", scan_seeds()[suffix], read_points)
    contents = [damaged(kind, np.random.default_rng([5, number])) for number in range(600)]
    assert 25 < read_alike(tmp_path, [(kind.path.name, content) for content in contents]) < 550


def read_alike(folder: Path, files: list[tuple[str, bytes]]) -> int:
    """Compare what JavaScript and Python read of each file, or that both refuse it; how many are read."""
    read = 0
    for (name, content), answer in zip(files, call("readers.js", "readScan", *map(list, files)), strict=True):
        (folder / name).write_bytes(content)
        try:
            expected = read_scan(folder / name).points
        except ScanError as error:
            assert answer.get("error", "").startswith(f"{name}: "), (error, content[:200])
            continue
        assert "result" in answer, (answer, content[:200])
        found = np.array(answer["result"]["points"], np.float32).reshape(-1, 4)
        np.testing.assert_array_equal(found, expected, str(content[:200]))
        read += 1
    return read
