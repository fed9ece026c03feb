"""Scans in other frames, and every direction, with the tiny bundle: which boxes come back and where."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_deploy import Detections, Detector, sample_scan_path
from asca_deploy.around import about_ground, turns_around
from asca_pillars.geometry.boxes import wrap_angle
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.ops.pillar.grid import PillarGrid
from asca_pillars.scans.ground_height import fit_ground_plane
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_reader import read_scan
from tests.deploy.conftest import EXPECTED_INPUT, SPEC, make_scan, write_bundle
from tests.helpers.bundles import DENSE_FLOAT32, DENSE_INT8

Points = NDArray[np.float32]
TRAINED_M = 1.75  # the middle of EXPECTED_INPUT.ground_z_m


def same(a: Detections, b: Detections, atol: float = 0.0) -> bool:
    if len(a) != len(b) or not np.array_equal(a.labels, b.labels):
        return False
    turned = np.abs(wrap_angle(a.boxes[:, 6] - b.boxes[:, 6])) <= atol
    return bool(np.allclose(a.boxes[:, :6], b.boxes[:, :6], atol=atol, rtol=0) and turned.all())


@pytest.mark.parametrize("axes", ["y-forward", "-y,x,z", "-x,-y,z", "x,-y,-z", "x,-y,z"])
def test_boxes_come_back_in_the_frame_of_the_scan(tiny_bundle: Path, scan: Points, axes: str) -> None:
    assert EXPECTED_INPUT.sensor_height_m == TRAINED_M
    expected = Detector(tiny_bundle)(scan)
    assert len(expected) > 3
    mounting = Mounting(axes=axes)
    found = Detector(tiny_bundle, mounting=mounting)(mounting.level.inverse.points(scan))
    assert same(found, Detections(mounting.level.inverse.boxes(expected.boxes), *_rest(expected)), atol=1e-5)
    np.testing.assert_allclose(found.bearings_rad, expected.bearings_rad, atol=1e-5)
    np.testing.assert_array_equal(found.plot(mounting.level.inverse.points(scan)), expected.plot(scan))


def test_another_height() -> None:
    """With the model that ships, whose answers do not hang on the last bit of a coordinate."""
    points = read_scan(sample_scan_path()).points
    ahead = Detector()
    trained_m = ahead.bundle.expected_input.sensor_height_m
    assert trained_m is not None
    raised = points + np.array([0, 0, trained_m, 0], np.float32)  # z = 0 is the ground
    height, view = ahead(raised).report.warnings
    assert "ground" in height and "--around" in view
    found = Detector(mounting=Mounting(sensor_height_m=0.0))(raised)
    assert found.report.warnings == (view,)
    assert Detector(mounting=Mounting(sensor_height_m=0.0), view="around")(raised).report.warnings == ()
    expected = ahead(points)
    assert len(found) == len(expected) > 5
    order, expected_order = (np.argsort(boxes[:, 0]) for boxes in (found.boxes, expected.boxes))  # of scores they swap
    np.testing.assert_allclose(found.boxes[order, 2] - expected.boxes[expected_order, 2], trained_m, atol=0.05)


def test_what_a_tilted_frame_leads_out_of_float32_is_dropped_and_counted(tiny_bundle: Path, scan: Points) -> None:
    """A driver's "no return" may be the largest number there is."""
    pose, tilt = np.eye(4), np.radians(3)
    pose[:3, :3] = [[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]]
    detector = Detector(tiny_bundle, mounting=Mounting(pose=pose))  # type: ignore[arg-type]
    scan[::50, :3] = np.finfo(np.float32).max
    found = detector(scan)
    assert found.report.non_finite_points == len(scan[::50])
    assert same(found, detector(np.delete(scan, np.s_[::50], axis=0)))


@pytest.fixture
def revolution() -> Points:
    """A scan all around: another street in each quarter."""
    return np.concatenate([FrameChange.turn(k * np.pi / 2).points(make_scan(k)) for k in range(4)])


def test_around_finds_in_each_quarter_what_a_turned_scan_has_ahead(tiny_bundle: Path, revolution: Points) -> None:
    ahead, around = Detector(tiny_bundle), Detector(tiny_bundle, view="around")
    assert (ahead.passes, ahead.view) == (1, "ahead")
    assert around.passes > 1
    found = around(revolution)
    assert found.report.passes == around.passes
    assert found.report.counts.points == around.passes * len(revolution)
    narrow = np.pi / around.passes - np.radians(10)  # where no neighbour has a say
    expected_input = around.bundle.expected_input
    turns = turns_around(around.spec.ranges, camera_view=expected_input.camera_view)
    for turn in about_ground(turns, revolution):
        alone = ahead(turn.points(revolution))
        angles = np.abs(np.arctan2(alone.boxes[:, 1], alone.boxes[:, 0]))
        expected = turn.inverse.boxes(alone.boxes[angles < narrow])
        distances = np.abs(found.boxes[None, :, :6] - expected[:, None, :6]).max(axis=2)
        assert (distances.min(axis=1) < 1e-4).all()


def test_a_turned_scan_gives_turned_boxes() -> None:
    """To three centimeters in float32: a ground that is estimated anew may pick other points of a full pillar.

    In 8 bits that can choose another one of two nearly equal boxes of a car, 10 cm longer.

    On level ground: of a slope every pass is shown what the scan has ahead, and a turned scan has another way ahead.
    """
    points = read_scan(sample_scan_path()).points
    plane = fit_ground_plane(points)
    assert plane is not None and plane.doubt is None
    points[:, 2] += points[:, :2] @ np.array(plane.normal[:2], np.float32) / plane.normal[2]
    detector = Detector(DENSE_FLOAT32, view="around")
    assert detector.passes == 4
    turn = FrameChange.turn(np.pi / 2)
    expected, found = detector(points), detector(turn.points(points))
    assert len(expected) > 12
    turned, sure = turn.boxes(expected.boxes), expected.scores > 0.5  # others may fall below their threshold
    nearest = np.abs(found.boxes[None, :, :6] - turned[:, None, :6]).max(axis=2)
    assert sure.sum() > 5 and (nearest.min(axis=1)[sure] < 0.03).all()
    np.testing.assert_allclose(found.scores[nearest.argmin(axis=1)][sure], expected.scores[sure], atol=0.05)


def test_a_car_on_a_seam_is_found_once() -> None:
    """The sample turned so that each of its clearest cars stands between two passes, and a little to either side."""
    points = read_scan(sample_scan_path()).points
    # Below the model's threshold: it is unsure of cars that stand slantwise, but never sees one in both passes.
    detector = Detector(DENSE_INT8, view="around", score_threshold=0.3)
    assert detector.passes == 4
    found = detector(points)
    cars = found[(found.labels == 0) & (found.distances_m < 25)][:3]
    assert len(cars) == 3 and cars.scores.min() > 0.8
    for car, off_seam_deg in zip(cars, (-2, 0, 2), strict=True):
        turn = FrameChange.turn(np.radians(45 + off_seam_deg) - np.arctan2(car.y_m, car.x_m))
        here = turn.boxes(car.box[None])[0]
        again = detector(turn.points(points))
        near = np.hypot(*(again.boxes[:, :2] - here[:2]).T) < 2
        assert near.sum() == 1
        assert again.labels[near] == 0


def test_streams_and_threads_find_the_same_around(tiny_bundle: Path, scans: list[Points]) -> None:
    detector = Detector(tiny_bundle, view="around", mounting=Mounting(axes="y-forward"))
    alone = [detector(points) for points in scans]
    assert all(map(same, detector.stream(scans), alone))
    with ThreadPoolExecutor(3) as pool:
        assert all(map(same, pool.map(detector, scans * 4), alone * 4))


def _rest(found: Detections) -> tuple:
    return found.scores, found.labels, found.class_names


def test_weights_of_whole_revolutions_look_around_in_one_pass(tmp_path: Path, revolution: Points) -> None:
    """As the bundle does that was exported with the wider ranges."""
    grid = PillarGrid(x_range_m=(0.0, 8.96), y_range_m=(-1.28, 2.56), v_max_m=0.16, zones=1)
    wide_grid = replace(grid, x_range_m=(-8.96, 8.96), y_range_m=(-8.96, 8.96))
    roomy = replace(SPEC, limits=replace(SPEC.limits, max_pillars=4000))
    narrow, wide = (
        Detector(write_bundle(tmp_path / name, active_cells="sub", spec=replace(roomy, grid=own)), view="around")
        for name, own in (("narrow", grid), ("wide", wide_grid))
    )
    assert narrow.passes == wide.passes == 1
    found, same_found = narrow(revolution), wide(revolution)
    assert len(found) > 20
    assert (found.boxes[:, 0] < -2).any()
    assert same(found, same_found)
    assert found.ranges == same_found.ranges == wide_grid.ranges


def test_views_of_a_camera_dense_necks_and_pillars_of_several_sizes_are_turned(tmp_path: Path) -> None:
    even = replace(SPEC, grid=replace(SPEC.grid, x_range_m=(0.0, 8.96), v_max_m=0.16, zones=1))
    seen = replace(EXPECTED_INPUT, camera_view=True)
    bundles = (
        write_bundle(tmp_path / "camera", active_cells="sub", spec=even, expected_input=seen),
        write_bundle(tmp_path / "zones", active_cells="sub"),
        write_bundle(tmp_path / "dense"),
    )
    assert all(Detector(bundle, view="around").passes > 1 for bundle in bundles)
