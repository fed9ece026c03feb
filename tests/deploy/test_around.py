"""When a detector looks all around, which passes there are, and how their boxes become one list."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely import MultiPoint, Point

from asca_deploy import Detector, sample_scan_path
from asca_deploy.around import about_ground, merge, ranges_around, turns_around, widen_ranges, without_own_vehicle
from asca_deploy.bundle import PillarBundle
from asca_deploy.manifest import load_bundle
from asca_deploy.open_model import RuntimeOptions, files_need_around
from asca_deploy.shipped import shipped_bundles
from asca_pillars.base.errors import ConfigError
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.boxes import Ranges, corners, wrap_angle
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.scans.scan_reader import read_scan
from asca_pillars.scans.scan_settings import ScanInput, ScanSettings

Z_M = (-3.0, 1.0)
KITTI = Ranges((0.0, 69.12), (-30.72, 30.72), Z_M)
NAMES = ("Car", "Pedestrian")


def detections(*rows: tuple[float, ...]) -> Detections:
    """Rows x, y, yaw, score, label of cars of one size."""
    table = np.array(rows, np.float64).reshape(-1, 5)
    boxes = np.zeros((len(table), 7), np.float32)
    boxes[:, :2], boxes[:, 2:6], boxes[:, 6] = table[:, :2], [-1, 4, 1.6, 1.5], table[:, 2]
    return Detections(boxes, table[:, 3].astype(np.float32), table[:, 4].astype(np.int64), NAMES)


@pytest.mark.parametrize(
    ("ranges", "camera_view", "passes"),
    [
        (KITTI, True, 4),
        (Ranges((0.0, 69.12), (-39.68, 39.68), Z_M), True, 4),
        (Ranges((-51.2, 51.2), (-51.2, 51.2), Z_M), False, 1),
        (Ranges((-51.2, 51.2), (-51.2, 51.2), Z_M), True, 4),
        (Ranges((0.0, 40.0), (-40.0, 40.0), Z_M), False, 3),
        (Ranges((2.0, 40.0), (-10.0, 40.0), Z_M), False, 3),
        (Ranges((-20.0, 60.0), (-40.0, 40.0), Z_M), False, 2),
    ],
)
def test_as_many_passes_as_the_field_of_view_needs(ranges: Ranges, camera_view: bool, passes: int) -> None:
    turns = turns_around(ranges, camera_view=camera_view)
    assert len(turns) == passes
    assert turns[0].is_identity


@pytest.mark.parametrize("y_m", [(1.28, 15.36), (-15.36, -1.28), (0.0, 39.68)])
def test_a_model_that_does_not_see_to_both_sides_is_not_turned(y_m: tuple[float, float]) -> None:
    with pytest.raises(ConfigError, match=r"view around: the model looks .* choose view ahead"):
        turns_around(Ranges((0.0, 69.12), y_m, Z_M), camera_view=True)


@given(st.lists(st.tuples(*[st.floats(-3, 3)] * 2, *[st.floats(0.5, 6)] * 2, st.floats(-3.2, 3.2)), max_size=8))
def test_a_box_around_the_sensor_is_left_out(rows: list[tuple[float, ...]]) -> None:
    boxes = np.array([[x, y, 0, length, width, 1, yaw] for x, y, length, width, yaw in rows], np.float32).reshape(-1, 7)
    scores, labels = np.linspace(0, 1, len(boxes), dtype=np.float32), np.zeros(len(boxes), np.int64)
    rest = without_own_vehicle(Detections(boxes, scores, labels, ("Car",)))
    kept = set(rest.scores.tolist())
    for box, score in zip(boxes, scores.tolist(), strict=True):
        area = MultiPoint(corners(box[None])[0, :, :2]).convex_hull
        if area.boundary.distance(Point(0, 0)) > 1e-4:
            assert (score in kept) != area.contains(Point(0, 0))


def test_around_leaves_out_the_box_around_the_sensor_and_ahead_does_not(
    tiny_bundle: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    boxes = np.array([[0.5, 0, -1, 4, 1.6, 1.5, 0], [6, 0, -1, 4, 1.6, 1.5, 0]], np.float32)
    found = Detections(boxes, np.array([0.9, 0.8], np.float32), np.zeros(2, np.int64), NAMES)
    points = np.zeros((5, 4), np.float32)
    for view, left in (("ahead", 2), ("around", 1)):
        detector = Detector(tiny_bundle, view=view)  # type: ignore[arg-type]
        monkeypatch.setattr(detector.pipeline, "finish", lambda *_: found)
        monkeypatch.setattr(detector, "_turns", (FrameChange.turn(0.0),))
        assert len(detector(points)) == left


@given(st.floats(-np.pi, np.pi), st.floats(1, 30))
def test_every_direction_is_in_a_pass(angle: float, distance: float) -> None:
    point = distance * np.array([[np.cos(angle), np.sin(angle), 0]])
    ahead = [turn.points(point)[0] for turn in turns_around(KITTI, camera_view=True)]
    assert any(0 <= x <= 69.12 and abs(y) <= 30.72 and abs(y) <= x + 1e-3 for x, y, _ in ahead)


def test_where_the_passes_look_together() -> None:
    assert ranges_around(KITTI, 1) == KITTI
    assert ranges_around(KITTI, 4) == Ranges((-69.12, 69.12), (-69.12, 69.12), Z_M)


@given(st.floats(-12, 12), st.floats(5, 28), st.floats(-3, 3), st.floats(-0.3, 0.3), st.sampled_from([0, 1]))
def test_what_stands_on_a_seam_is_found_once(
    off_seam_deg: float, distance: float, yaw: float, noise_m: float, label: int
) -> None:
    """Seen by two passes, a little apart; the one that sees it nearer to straight ahead is believed."""
    angle = np.radians(45 + off_seam_deg)
    x, y = distance * np.cos(angle), distance * np.sin(angle)
    turns = turns_around(KITTI, camera_view=True)
    first = detections((x, y, yaw, 0.5, label))
    left = FrameChange(turns[1].axes, turns[1].shift_m).boxes(detections((x + noise_m, y, yaw, 0.9, label)).boxes)
    second = Detections(left, np.array([0.9], np.float32), np.array([label]), NAMES)
    empty = Detections.empty(NAMES)
    merged = merge([first, second, empty, empty], turns, 0.01)
    assert len(merged) == 1
    angles = [abs(float(np.arctan2(found.boxes[0, 1], found.boxes[0, 0]))) for found in (first, second)]
    expected = 0.5 if angles[0] <= angles[1] else 0.9
    assert merged.scores[0] == np.float32(expected)
    np.testing.assert_allclose(merged.boxes[0, :2], [x if expected == 0.5 else x + noise_m, y], atol=1e-4)
    assert abs(float(wrap_angle(merged.boxes[0, 6] - yaw))) < 1e-5


def test_neighbours_of_different_classes_both_stay() -> None:
    turns = turns_around(KITTI, camera_view=True)
    first, empty = detections((10, 9, 0, 0.5, 0), (10, 9, 0, 0.9, 1)), Detections.empty(NAMES)
    merged = merge([first, empty, empty, empty], turns, 0.01)
    np.testing.assert_array_equal(merged.labels, [1, 0])  # the better first


def test_a_wider_range_has_room_for_as_many_proposals_as_the_passes_it_replaces() -> None:
    bundle = load_bundle(shipped_bundles()["accurate"])
    assert isinstance(bundle, PillarBundle) and bundle.refine is not None
    wide = widen_ranges(bundle)
    assert isinstance(wide, PillarBundle) and wide.refine is not None
    ahead, around = bundle.refine.seen, wide.refine.seen
    assert around.proposals.quotas == tuple(3 * quota for quota in ahead.proposals.quotas)
    assert around.proposals.candidates == 3 * ahead.proposals.candidates
    assert around.keypoints.count == 3 * ahead.keypoints.count
    assert widen_ranges(wide) == wide  # trained for every direction, its settings are those of every direction
    views = replace(bundle, expected_input=replace(bundle.expected_input, camera_view=True))
    assert widen_ranges(views) == views


def test_what_a_pass_sees_far_beside_its_sector_does_not_count() -> None:
    turns = turns_around(KITTI, camera_view=True)
    beside, empty = detections((5, 20, 0, 0.9, 0)), Detections.empty(NAMES)
    assert len(merge([beside, empty, empty, empty], turns, 0.01)) == 0


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.02, 0.0), (0.01, -0.015)])
def test_every_pass_sees_the_ground_as_the_first_one_does(slope: tuple[float, float]) -> None:
    """A pitched sensor: turned about z, a road that rises ahead would sink in the pass that looks behind."""
    rng = np.random.default_rng(0)
    ground = rng.uniform(-25, 25, (40_000, 4))
    ground[:, 2] = ground[:, :2] @ slope - 1.73 + rng.normal(0, 0.02, len(ground))
    scan = ground.astype(np.float32)
    turns = about_ground(turns_around(KITTI, camera_view=True), scan)
    assert turns[0].is_identity
    for turn in turns:
        turned = turn.points(scan)
        assert np.abs(turned[:, :2] @ slope - 1.73 - turned[:, 2]).mean() < 0.03
        box = np.array([[20, -3, -1, 4, 2, 1.5, 0.4]])
        np.testing.assert_allclose(turn.inverse.boxes(turn.boxes(box)), box, atol=2e-3)


def test_without_a_ground_the_passes_turn_about_z() -> None:
    turns = turns_around(KITTI, camera_view=True)
    cloud = np.random.default_rng(0).uniform(-20, 20, (20_000, 4)).astype(np.float32)
    for points in (cloud, cloud[:0]):
        for turn, plain in zip(about_ground(turns, points), turns, strict=True):
            np.testing.assert_array_equal(turn.axes, plain.axes)


def test_scans_all_around_the_sensor_are_looked_at_in_every_direction(tmp_path: Path) -> None:
    """Also where x is not forward; a camera's part of a scan, and KITTI's frames, are looked at ahead."""
    revolution = read_scan(sample_scan_path()).points
    turned = np.column_stack([-revolution[:, 1], revolution[:, 0], revolution[:, 2:]])  # x right, y forward
    part = revolution[np.abs(np.arctan2(revolution[:, 1], revolution[:, 0])) < 0.7]
    for points, axes, bundle, cost in [
        (revolution, "x-forward", "default", "in one pass"),
        (turned, "y-forward", "default", "in one pass"),
        (revolution, "x-forward", "accurate", "in one pass"),
        (part, "x-forward", "default", None),
    ]:
        path = tmp_path / "scan.npy"
        np.save(path, points)
        scan_input = ScanInput(ScanSettings(axes=axes), [path])
        assert files_need_around(RuntimeOptions(bundle=bundle), scan_input) == (cost is not None)
        assert cost is None or any(f"looking all around, {cost} (--ahead" in line for line in scan_input.notes)
    in_kitti_layout = tmp_path / "velodyne" / "000000.bin"
    for file in (in_kitti_layout, tmp_path / "calib" / "000000.txt"):
        file.parent.mkdir()
        file.touch()
    revolution.tofile(in_kitti_layout)
    for labelled_ahead in (in_kitti_layout, sample_scan_path()):
        assert not files_need_around(RuntimeOptions(), ScanInput(ScanSettings(), [labelled_ahead]))
