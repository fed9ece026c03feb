"""Scans of another sensor on the command line: axes, height, pose, scale, columns, all around."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner, Result

from asca_deploy import sample_scan_path
from asca_pillars.base.errors import AscaError, ScanError
from asca_pillars.cli.main import app
from asca_pillars.cli.options import scan_settings
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_input import ScanInput
from asca_pillars.scans.scan_reader import read_scan, write_scan
from asca_pillars.scans.scan_settings import ScanSettings, sample_points


def detect(tmp_path: Path, *arguments: object) -> tuple[Result, list[dict]]:
    """Run `asca detect`; its boxes of the first scan."""
    out = tmp_path / "out"
    result = CliRunner().invoke(app, ["detect", "--out", str(out), *map(str, arguments)])
    lines = (out / "detections.jsonl").read_text().splitlines() if result.exit_code == 0 else []
    return result, [json.loads(line) for line in lines]


@pytest.fixture(scope="module")
def sample() -> NDArray[np.float32]:
    return read_scan(sample_scan_path()).points


def test_the_sample_seen_otherwise_gives_its_own_boxes(tmp_path: Path, sample: NDArray[np.float32]) -> None:
    """x to the right, z = 0 on the ground, reflectance 0..255, five columns."""
    _, (expected,) = detect(tmp_path, "--no-pictures")
    mounting = Mounting(axes="y-forward")
    points = mounting.level.inverse.points(sample + np.array([0, 0, 1.73, 0], np.float32))
    table = np.column_stack([points[:, :3], np.round(points[:, 3] * 255), np.arange(len(points)) % 32])
    path = tmp_path / "other.bin"
    table.astype("<f4").tofile(path)
    result, (found,) = detect(
        tmp_path, path, "--axes", "y-forward", "--sensor-height", "auto", "--columns", 5, "--ahead"
    )
    assert result.exit_code == 0, result.output
    assert "sensor height: 0.0" in result.output and "estimated from 1 scan" in result.output
    assert found["reflectance_scale"] == 255
    where = np.array([[box["x_m"], box["y_m"], box["z_m"]] for box in expected["boxes"]])
    here = np.array([[box["x_m"], box["y_m"], box["z_m"]] for box in found["boxes"]])
    turned = np.column_stack([-where[:, 1], where[:, 0], where[:, 2] + 1.73])
    distances = np.linalg.norm(turned[:, None] - here[None], axis=2).min(axis=1)
    assert (distances < 0.5).mean() >= 0.8  # the height is an estimate, and the scores of some are near the threshold
    assert (tmp_path / "out" / "other_bev.png").exists()


def test_all_around(tmp_path: Path) -> None:
    result, (found,) = detect(tmp_path, "--around")
    assert result.exit_code == 0, result.output
    assert found["warnings"] == []
    assert found["passes"] == 4 and found["points"] == 4 * 123_301
    assert "in 4 passes" in result.output and "right" in result.output
    behind = [box for box in found["boxes"] if box["x_m"] < -5]
    assert len(behind) >= 3


def test_what_is_behind_is_looked_at_or_said_to_be_left_out(tmp_path: Path, sample: NDArray[np.float32]) -> None:
    scans = tmp_path / "street.bin", tmp_path / "ahead.bin"
    for path, points in zip(scans, (sample, sample[sample[:, 0] > np.abs(sample[:, 1])]), strict=True):
        write_scan(path, points)
    result, found = detect(tmp_path, *scans, "--no-pictures")
    assert "49% of the points lie behind the sensor: looking all around, in 4 passes (--ahead:" in result.output
    assert [scan["passes"] for scan in found] == [4, 4] and not any(scan["warnings"] for scan in found)
    result, found = detect(tmp_path, *scans, "--no-pictures", "--ahead")
    assert "street.bin: 49% of the points lie behind" in result.output and "(--around)" in result.output
    assert ["--around" in "".join(scan["warnings"]) for scan in found] == [True, False]


def test_a_folder_has_one_reflectance_scale(tmp_path: Path, sample: NDArray[np.float32]) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    for number, brightness in enumerate([255.0, 1.0]):  # the second one is dark
        write_scan(folder / f"{number}.bin", sample[::10] * np.array([1, 1, 1, brightness], np.float32))
    paths = sorted(folder.iterdir())
    scan_input = ScanInput(ScanSettings(), paths)
    assert any("0..255" in text for text in scan_input.notes)
    assert [scan_input.read(path).notes.reflectance_scale for path in paths] == [255, 255]
    stated = ScanInput(ScanSettings(reflectance_scale=100.0), paths)
    assert [stated.read(path).notes.reflectance_scale for path in paths] == [100, 100]
    assert not stated.notes


def test_the_height_of_several_scans(tmp_path: Path, sample: NDArray[np.float32]) -> None:
    for number in range(3):
        write_scan(tmp_path / f"{number}.bin", sample)
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


def test_detect_goes_on_with_a_scan_without_ground(tmp_path: Path, sample: NDArray[np.float32]) -> None:
    folder, wall = tmp_path / "sweeps", sample[::10].copy()
    wall[:, 0] = 5.0
    for name, points in (("000.bin", sample[::4]), ("001.bin", wall)):
        write_scan(folder / name, points)
    result, lines = detect(tmp_path, folder, "--sensor-height", "auto", "--no-pictures", "-b", "fast")
    assert result.exit_code == 0 and len(lines) == 2, "the height is left out, the boxes are not"
    assert "left out: " in result.output and "001.bin" in result.output


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
