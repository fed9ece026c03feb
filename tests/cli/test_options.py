"""Options of several commands: how a sensor stands (axes, height, pose, scale, columns, all around), and `--score`."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_deploy import Detector, sample_scan_path
from asca_pillars.base.errors import AscaError, ConfigError, ScanError
from asca_pillars.cli.options import read_scores, scan_settings
from asca_pillars.evaluation.arguments import scores_by_class
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_reader import write_scan
from asca_pillars.scans.scan_settings import ScanInput, ScanSettings, sample_points
from tests.cli.short_drive import BUNDLE, SAMPLE, read_lines
from tests.helpers.bundles import DENSE_INT8
from tests.helpers.in_process import invoke, run_here

POINTS = SAMPLE[::4]


def detect(tmp_path: Path, *arguments: object) -> tuple[str, list[dict]]:
    """Run `asca detect` with a small model; what it prints, and its lines."""
    output = invoke("detect", "--out", tmp_path / "out", "-b", BUNDLE, "--threads", 1, *arguments)
    return output, read_lines(tmp_path / "out")


def centers(line: dict) -> NDArray[np.float64]:
    return np.array([[box["x_m"], box["y_m"], box["z_m"]] for box in line["boxes"]])


def test_the_sample_seen_otherwise_gives_its_own_boxes(tmp_path: Path) -> None:
    """x to the right, z = 0 on the ground, reflectance 0..255, five columns."""
    write_scan(tmp_path / "plain.bin", POINTS)
    _, (expected,) = detect(tmp_path, tmp_path / "plain.bin", "--ahead", "--no-pictures")
    points = Mounting(axes="y-forward").level.inverse.points(POINTS + np.array([0, 0, 1.73, 0], np.float32))
    table = np.column_stack([points[:, :3], np.round(points[:, 3] * 255), np.arange(len(points)) % 32])
    table.astype("<f4").tofile(tmp_path / "other.bin")
    options = ("--axes", "y-forward", "--sensor-height", "auto", "--columns", 5, "--ahead")
    output, (found,) = detect(tmp_path, tmp_path / "other.bin", *options)
    assert "sensor height: 0.0" in output and "estimated from 1 scan" in output
    assert found["reflectance_scale"] == 255
    where = centers(expected)
    turned = np.column_stack([-where[:, 1], where[:, 0], where[:, 2] + 1.73])
    distances = np.linalg.norm(turned[:, None] - centers(found)[None], axis=2).min(axis=1)
    assert (distances < 0.5).mean() >= 0.8  # the height is an estimate, and the scores of some are near the threshold
    assert len(where) > 3 and (tmp_path / "out" / "other_bev.png").exists()


def test_what_is_behind_is_looked_at_or_said_to_be_left_out(tmp_path: Path) -> None:
    scans = tmp_path / "street.bin", tmp_path / "ahead.bin"
    for path, points in zip(scans, (POINTS, POINTS[POINTS[:, 0] > np.abs(POINTS[:, 1])]), strict=True):
        write_scan(path, points)
    output, found = detect(tmp_path, *scans, "--no-pictures")
    assert "49% of the points lie behind the sensor: looking all around, in one pass (--ahead:" in output
    assert [scan["passes"] for scan in found] == [1, 1] and not any(scan["warnings"] for scan in found)
    assert found[0]["points"] == len(POINTS) and (centers(found[0])[:, 0] < -5).sum() >= 3
    output, found = detect(tmp_path, *scans, "--no-pictures", "--ahead")
    assert "street.bin: 49% of the points lie behind" in output and "(--around)" in output
    assert ["--around" in "".join(scan["warnings"]) for scan in found] == [True, False]
    output, (scan,) = detect(tmp_path, scans[1], "--around", "-b", DENSE_INT8)
    assert scan["passes"] == 4 and "in 4 passes" in output and "right" in output


def test_a_folder_has_one_reflectance_scale(tmp_path: Path) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    for number, brightness in enumerate([255.0, 1.0]):  # the second one is dark
        write_scan(folder / f"{number}.bin", POINTS[::4] * np.array([1, 1, 1, brightness], np.float32))
    paths = sorted(folder.iterdir())
    scan_input = ScanInput(ScanSettings(), paths)
    assert any("0..255" in text for text in scan_input.notes)
    assert [scan_input.read(path).notes.reflectance_scale for path in paths] == [255, 255]
    stated = ScanInput(ScanSettings(reflectance_scale=100.0), paths)
    assert [stated.read(path).notes.reflectance_scale for path in paths] == [100, 100]
    assert not stated.notes


def test_the_height_of_several_scans(tmp_path: Path) -> None:
    for number in range(3):
        write_scan(tmp_path / f"{number}.bin", POINTS)
    (tmp_path / "3.bin").write_bytes(b"damaged")
    scan_input = ScanInput(ScanSettings(sensor_height="auto"), sorted(tmp_path.iterdir()))
    assert scan_input.mounting.sensor_height_m == pytest.approx(1.73, abs=0.05)
    assert any("from 3 scans" in text for text in scan_input.notes)


def test_scans_that_are_spread_over_all_are_looked_at_first_and_then_those_between() -> None:
    def read(path: Path) -> NDArray[np.float32]:
        if path.name == "5":
            raise ScanError("damaged")
        return np.zeros((int(path.name != "10"), 4), np.float32)

    names = [int(name) for name, _ in sample_points([Path(f"{number}") for number in range(40)], read)]
    assert names == [*(0, 15, 20, 25, 30, 35), *range(1, 40, 5), *range(2, 40, 5), *range(3, 40, 5)]


def test_detect_goes_on_with_a_scan_without_ground(tmp_path: Path) -> None:
    folder, wall = tmp_path / "sweeps", POINTS[::3].copy()
    wall[:, 0] = 5.0
    for name, points in (("000.bin", POINTS), ("001.bin", wall)):
        write_scan(folder / name, points)
    output, lines = detect(tmp_path, folder, "--sensor-height", "auto", "--no-pictures")
    assert len(lines) == 2, "the height is left out, the boxes are not"
    assert "left out: " in output and "001.bin" in output


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sensor_height": "tall"}, "--sensor-height tall: give a number or auto"),
        ({"sensor_height": "40"}, "sensor height 40: give metres"),
        ({"reflectance_scale": "bright"}, "--reflectance-scale bright"),
        ({"reflectance_scale": "-1"}, "reflectance_scale -1: must be positive"),
        ({"reflectance_scale": "nan"}, "reflectance_scale nan: must be positive"),
        ({"columns": 2}, "columns 2"),
        ({"axes": "up"}, "axes up: give x-forward"),
        ({"pose": Path("none.txt")}, r"none\.txt"),
        ({"pose": Path("none.txt"), "axes": "y-forward"}, "give one of them"),
    ],
)
def test_wrong_options(options: dict[str, Any], message: str) -> None:
    unset = {"sensor_height": None, "axes": "x-forward", "pose": None, "reflectance_scale": "auto", "columns": None}
    with pytest.raises(AscaError, match=message):
        ScanInput(scan_settings(**(unset | options)), [sample_scan_path()])


@pytest.mark.parametrize(
    ("texts", "scores"),
    [
        (None, None),
        (["0.4"], 0.4),
        (["Car=0.4", "Van=with=sign=1e-1"], {"Car": 0.4, "Van=with=sign": 0.1}),
        (["Car=0.4", "Car=0.5"], {"Car": 0.5}),
    ],
)
def test_scores_as_typed(texts: list[str] | None, scores: Any) -> None:
    assert read_scores(texts) == scores


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        *(([text], r"such as Car=0\.35") for text in ("high", "Car=", "=0.4", "Car=high", "")),
        *((texts, "is for every class; give it alone") for texts in (["0.4", "Car=0.5"], ["Car=0.5", "0.4"])),
    ],
)
def test_what_is_no_score(texts: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read_scores(texts)


def test_the_others_keep_their_own() -> None:
    own = {"Car": 0.5, "Cyclist": 0.3}
    assert scores_by_class(None, own) == own
    assert scores_by_class(0.2, own) == {"Car": 0.2, "Cyclist": 0.2}
    assert scores_by_class({"Car": 0.1}, own) == {"Car": 0.1, "Cyclist": 0.3}
    with pytest.raises(ConfigError, match="--score Van: no such class; available: Car, Cyclist"):
        scores_by_class({"Van": 0.1}, own)


def test_detect_and_the_detector_agree(tmp_path: Path) -> None:
    np.save(tmp_path / "scan.npy", POINTS)
    scores = ("--score", "Car=0.9", "--score", "Cyclist=0.2")
    _, (line,) = detect(tmp_path, tmp_path / "scan.npy", "--ahead", "--no-pictures", *scores)
    detector = Detector(BUNDLE, score_threshold={"Car": 0.9, "Cyclist": 0.2})
    expected = detector(POINTS).names
    assert [box["class"] for box in line["boxes"]] == expected and expected
    assert expected != Detector(BUNDLE)(POINTS).names
    own = {one.name: one.score_threshold for one in detector.bundle.spec.classes}
    assert {one.name: one.score_threshold for one in detector.spec.classes} == own | {"Car": 0.9, "Cyclist": 0.2}


@pytest.mark.parametrize(
    ("score", "message"),
    [
        ("Lorry=0.4", "Lorry: no such class; available: Car, Pedestrian, Cyclist"),
        ("Car=1.5", "score_threshold 1.5 of class Car must lie between 0 and 1"),
        ("Car:0.4", "such as Car=0.35"),
    ],
)
def test_mistakes_are_one_line(tmp_path: Path, score: str, message: str) -> None:
    result = run_here("detect", "-b", BUNDLE, "-o", tmp_path / "out", "--score", score)
    assert result.returncode > 1 and result.stderr.count("\n") == 1
    assert message in result.stderr and not (tmp_path / "out").exists()
