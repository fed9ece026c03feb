"""How labels lie around points, on cars and people made of a few planes."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asca_pillars.data.kitti import KittiSplit, boxes_from_objects, objects_3d, objects_from_boxes
from asca_pillars.scans.scan_reader import read_scan
from asca_pillars.sim.report.comparison import Measured, compare
from asca_pillars.sim.report.reference import CLASSES, Fit, kitti_reference
from asca_pillars.sim.report.scan_statistics import (
    COLUMNS,
    WINDOW_RETURNS,
    ScanRecord,
    fits_of,
    object_fits,
    window_returns,
    zero_shares,
)
from asca_pillars.sim.report.tables import fits_table
from tests.helpers.scenes import CALIBRATION


def flank(box: list[float], share_of_windows: float) -> np.ndarray:
    """Points (N, 3) on the right side of a box, evenly spread, with that share of them between 0.6 and 0.9 h."""
    x, y, z, length, width, height, yaw = box
    along, up = np.meshgrid(np.linspace(-0.5, 0.5, 200), np.linspace(0.0, 1.0, 101))
    step = max(round(1 / share_of_windows), 1) if share_of_windows else 0
    on_window = (up > 0.6) & (up < 0.9)
    column = np.broadcast_to(np.arange(200), along.shape)
    kept = ~on_window | ((column % step == 0) if step else False)
    a, u = along[kept] * length, (up[kept] - 0.5) * height
    b = np.full(len(a), -width / 2)
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.column_stack([x + a * cos - b * sin, y + a * sin + b * cos, z + u])


@pytest.mark.parametrize("share", [1.0, 0.5, 0.25])
def test_windows_are_measured_against_the_doors_below_them(share: float) -> None:
    box = [12.0, 4.0, -0.9, 4.0, 1.7, 1.5, 0.9]
    found = window_returns(flank(box, share), np.array(box))
    assert found == pytest.approx(share, rel=0.1)


@pytest.mark.parametrize("yaw", [0.0, 0.9, -2.2])
def test_points_without_reflectance_are_counted_on_doors_and_above_them(yaw: float) -> None:
    box = [12.0, 4.0, -0.9, 4.0, 1.7, 1.5, yaw]
    points = flank(box, 1.0)
    up = (points[:, 2] - box[2]) / box[5] + 0.5
    reflectance = np.where(up > 0.6, 0.0, 0.3)
    reflectance[::4] = 0.004  # KITTI's step is 0.01
    on_car = np.column_stack([points, reflectance])
    scan = np.concatenate([on_car, on_car * (1, 1, 1, 0) + np.array([5.0, 5.0, 0.0, 0.3])])
    assert zero_shares(scan, np.array(box)) == pytest.approx((0.25, 1.0), abs=0.02)


def test_what_cannot_be_measured_is_left_out() -> None:
    for box in ([12.0, 0.0, -0.9, 4.0, 1.7, 1.5, 0.05], [30.0, 4.0, -0.9, 4.0, 1.7, 1.5, 0.9]):
        assert np.isnan(window_returns(flank(box, 1.0), np.array(box)))
    far = [45.0, 4.0, -0.9, 4.0, 1.7, 1.5, 0.9]
    for box, step in ((far, 1), ([12.0, *far[1:]], 2000)):
        points = flank(box, 1.0)[::step]
        assert np.isnan(zero_shares(np.column_stack([points, np.zeros(len(points))]), np.array(box))).all()
    box = [12.0, 4.0, -0.9, 4.0, 1.7, 1.5, 0.9]
    assert np.isnan(window_returns(flank(box, 1.0)[::2000], np.array(box))), "too few points to tell"
    boxes = np.array([[10.0, 3.0, -0.8, 0.8, 0.6, 1.7, 0.0]] * 3)
    objects = objects_from_boxes(boxes, ["Pedestrian", "Pedestrian", "Cyclist"], CALIBRATION)
    rng = np.random.default_rng(0)
    points = rng.uniform((9.7, 2.8, -1.5, 0.0), (9.9, 3.2, -0.2, 1.0), (300, 4))  # on the sensor's side of the box
    objects = [replace(item, occluded=hidden, truncated=0.0) for item, hidden in zip(objects, (0, 1, 0), strict=True)]
    found = object_fits(points, objects, boxes)
    assert {name: len(rows) for name, rows in found.items()} == {"Car": 0, "Pedestrian": 1, "Cyclist": 1}
    median = found["Pedestrian"][0, COLUMNS.index("range_50")]
    assert -0.3 < median < -0.1


def test_sums_are_medians_and_shares_are_means() -> None:
    rows = {name: np.full((4, len(COLUMNS)), np.nan) for name in CLASSES}
    rows["Car"][:, COLUMNS.index("flank_end")] = -0.1, -0.2, -0.3, np.nan
    rows["Car"][:, COLUMNS.index("low_inside")] = 0, 0, 0, 1
    rows["Car"][:1, COLUMNS.index(WINDOW_RETURNS)] = 0.5
    fits = fits_of(rows, "here")
    assert set(fits) == {"Car flank_end", "Car low_inside"}, "one car's windows tell nothing"
    ends = fits["Car flank_end"][0]
    assert (ends.source, ends.objects) == ("here", 3)
    assert (ends.middle, ends.low, ends.high) == pytest.approx((-0.2, -0.28, -0.12))
    assert fits["Car low_inside"][0].middle == pytest.approx(0.25)
    assert "| Car flank_end | -0.20 (3) |" in fits_table(fits)


def test_a_set_may_be_as_far_off_as_the_drives_are_from_each_other() -> None:
    real = kitti_reference().statistics
    assert len(real.label_fit["Car rear_width"]) >= 3 and len(real.label_fit["Pedestrian range_50"]) == 2
    like: dict[str, tuple[Fit, ...]] = {
        name: (Fit("this set", 100, fits[0].middle, 0.0, 0.0),) for name, fits in real.label_fit.items()
    }
    off = like | {"Car rear_width": (Fit("this set", 100, -0.2, -0.21, -0.19),)}
    records: list[ScanRecord] = []
    scan = replace(real.scan, reflectance={})
    for sets, missed in ((like, False), (off, True)):
        rows = compare(Measured(replace(real, scan=scan, label_fit=sets), records), real).rows
        width = next(row for row in rows if row.name == "Car rear_width")
        assert (width.within is False) is missed and width.bar == pytest.approx(0.04, abs=0.011)
        people = next(row for row in rows if row.name == "Pedestrian range_50")
        assert people.within is None and people.measure == "difference", "two drives bound nothing"


def test_the_reference_is_what_the_code_measures_on_real_frames() -> None:
    """A statistic that changes after the reference was measured compares unlike things."""
    root = os.environ.get("ASCA_KITTI_MINI")
    if not root:
        pytest.skip("ASCA_KITTI_MINI is not set: no real scans here")
    split = KittiSplit(Path(root))
    rows = []
    for frame_id in split.frame_ids:
        objects = objects_3d(split.objects(frame_id))
        boxes = boxes_from_objects(objects, split.calibration(frame_id))
        rows.append(object_fits(read_scan(split.scan_path(frame_id)).points, objects, boxes))
    measured = fits_of({name: np.concatenate([row[name] for row in rows]) for name in CLASSES}, "single frames")
    reference = {
        name: fit
        for name, fits in kitti_reference().statistics.label_fit.items()
        for fit in fits
        if fit.source == "single frames"
    }
    assert set(measured) == set(reference)
    for name, fit in reference.items():
        found = measured[name][0]
        assert found.objects == fit.objects, name
        assert (found.middle, found.low, found.high) == pytest.approx((fit.middle, fit.low, fit.high), abs=6e-4), name
