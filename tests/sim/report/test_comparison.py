"""A measured set beside a reference: alike, shifted, incomplete; and how it is told."""

import io
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from asca_pillars.sim.report.comparison import Comparison, Measured, Row, compare, measure
from asca_pillars.sim.report.plots import write_plots
from asca_pillars.sim.report.reference import kitti_reference
from asca_pillars.sim.report.tables import print_comparison, to_markdown, write_report
from tests.sim.report.made_up import write_set


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Measured:
    return measure(write_set(tmp_path_factory.mktemp("whole")))


def row(comparison: Comparison, name: str) -> Row:
    return next(item for item in comparison.rows if item.name == name)


def test_a_set_is_like_itself(measured: Measured) -> None:
    comparison = compare(measured, measured.statistics)
    assert len(comparison.rows) > 60
    for item in comparison.rows:
        # The share of a heading that no object has is 0 on both sides, and their ratio is not a number.
        nothing = item.measure == "ratio" and item.real == item.simulated == 0
        assert nothing or item.value == pytest.approx(1 if item.measure == "ratio" else 0, abs=1e-6), item
    assert sum(item.within is True for item in comparison.rows) == 4 + 4 + 4 + 5 and not comparison.missed


def test_a_shifted_histogram_is_caught(measured: Measured, tmp_path: Path) -> None:
    brighter = measure(write_set(tmp_path, brighter=0.1))
    comparison = compare(brighter, measured.statistics)
    missed = {item.name for item in comparison.missed}
    assert missed == {f"reflectance: {name}" for name in ("overall", "ground", "non_ground", "car", "pedestrian")}
    car = row(comparison, "reflectance: car")
    assert car.real is not None and car.simulated == pytest.approx(car.real + 2 / 3 * 0.1, abs=0.01)
    # A third of the points stays at 0, two thirds share nothing with where they were.
    assert car.value == pytest.approx(np.sqrt(2 / 3), abs=0.01)
    assert car.noise is not None and car.noise_of_points is not None and car.noise_of_points < 0.1
    assert row(comparison, "points per scan").value == 1


@pytest.mark.parametrize(("value", "kept"), [(0.84, False), (0.86, True), (1.14, True), (1.16, False)])
def test_the_bar_of_a_ratio_bounds_both_sides(value: float, kept: bool) -> None:
    assert Row("scans", "points", 1.0, value, "ratio", value, 0.15).within is kept
    assert Row("scans", "points", 1.0, value, "ratio", value).within is None
    assert Row("reflectance", "car", None, None, "distance", 0.149, 0.15).within is True


def test_few_real_objects_excuse_what_chance_explains() -> None:
    assert Row("reflectance", "van", None, None, "distance", 0.3, 0.15, noise=0.33).within_noise
    assert not Row("reflectance", "van", None, None, "distance", 0.3, 0.15, noise=0.29).within_noise
    assert not Row("reflectance", "van", None, None, "distance", 0.1, 0.15, noise=0.33).within_noise, (
        "nothing to excuse"
    )
    assert Row("points per car", "at 10 m", 100, 80, "ratio", 0.8, 0.15, noise=0.21).within_noise
    assert not Row("points per car", "at 10 m", 100, 80, "ratio", 0.8, 0.15).within_noise


def test_what_cannot_be_compared_is_said(measured: Measured, tmp_path: Path) -> None:
    view = measure(write_set(tmp_path, camera_view=True))
    comparison = compare(view, kitti_reference().statistics)
    names = {item.name for item in comparison.rows}
    assert "points in camera view" in names and "points of a car at 20 m" in names
    assert not names & {"points per scan", "ground share", "points per ring", "reflectance: overall"}
    told = " ".join(comparison.skipped)
    assert "--view full" in told and "no Cyclist is labelled" in told and "no returns of a van" in told
    other = replace(view.statistics, scan=replace(view.statistics.scan, car_fit=None, near_car_fit=None))
    assert any("no points per car" in line for line in compare(replace(view, statistics=other), other).skipped)


def test_the_reference_is_kitti_s() -> None:
    real = kitti_reference().statistics
    assert "Geiger" in real.source and "22 scans and 7,481 label files" in real.source
    assert real.scan.points is not None and real.scan.points.mean == pytest.approx(118787, abs=1)
    assert real.scan.car_fit is not None
    assert [round(real.scan.car_fit.points_at(range_m)) for range_m in (20, 30, 40, 50)] == [288, 81, 33, 17]
    near = real.scan.near_car_fit
    assert near is not None and (near.cars, round(near.points_at(20))) == (16, 281)
    assert real.labels["Car"].count == 28742 == sum(real.labels["Car"].range_counts)
    assert all(sum(labels.per_frame) == real.frames == 7481 for labels in real.labels.values())
    assert all(len(item.counts) == 100 for item in real.scan.reflectance.values())
    assert len(kitti_reference().sensor.elevation_deg) == len(real.scan.points_per_ring or ()) == 64


def test_the_report_the_pictures_and_the_console_tell_every_row(measured: Measured, tmp_path: Path) -> None:
    reference = kitti_reference()
    comparison = compare(measured, reference.statistics)
    plots = write_plots(tmp_path, comparison, measured, reference.sensor)
    write_report(tmp_path, comparison, plots)
    assert set(plots) == {"reflectance.png", "cars.png", "scans.png", "labels.png"}
    text = (tmp_path / "report.md").read_text()
    assert all(item.name in text for item in comparison.rows) and all(f"({name})" in text for name in plots)
    told = json.loads((tmp_path / "report.json").read_text())
    assert [item["name"] for item in told["rows"]] == [item.name for item in comparison.rows]
    assert told["simulated"]["labels"]["Car"]["count"] == 6
    for name in plots:
        picture = cv2.imread(str(tmp_path / name))
        assert picture is not None and picture.std() > 20, "lines on white"
    comparison = compare(measured, kitti_reference().statistics)
    console = Console(record=True, width=80, file=io.StringIO())
    print_comparison(comparison, console)
    shown = console.export_text()
    table = [line for line in shown.splitlines() if "1+-0.15" in line or "< 0.15" in line]
    assert len(table) == 17 and max(len(line.rstrip()) for line in table) <= 80
    assert "points per scan" in shown and f"missed: {comparison.missed[0].name}" in shown
    assert "| points per scan |" in to_markdown(comparison, ())
