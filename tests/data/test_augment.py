"""Augmentation: objects keep their points, headings and distances from each other, and nothing else moves."""

import copy
import dataclasses
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from asca_pillars.config.tree import AugmentConfig
from asca_pillars.data.augment import (
    FEWEST_POINTS,
    augment,
    change_reflectance,
    corrupt_objects,
    flip_y,
    move_objects,
    rotate,
    scale,
)
from asca_pillars.data.frames import LabeledFrame
from asca_pillars.geometry.boxes import points_in_boxes
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.geometry.overlap import bev_intersection
from tests.helpers.scenes import make_scene

STILL = AugmentConfig(
    flip_probability=0, rotation_rad=0, scale=(1, 1), shift_z_m=0, object_rotation_rad=0, object_shift_m=0,
    point_dropout=0,
)  # fmt: skip
STRONG = AugmentConfig(
    rotation_rad=math.pi, scale=(0.8, 1.25), shift_z_m=0.5, object_rotation_rad=1.0, object_shift_m=0.5
)
POINTS_PER_BOX = 25


def points_of(frame: LabeledFrame, index: int) -> np.ndarray:
    """The points that `frames` put into a box: the reflectance says which."""
    return frame.points[frame.points[:, 3] == np.float32(index + 1) / 100]


def local(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """x, y, z along the box's length, width and height."""
    dx, dy, dz = (points[:, :3].astype(np.float64) - box[:3].astype(np.float64)).T
    cos, sin = math.cos(box[6]), math.sin(box[6])
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx, dz], axis=1)


@st.composite
def frames(draw: st.DrawFn) -> LabeledFrame:
    """Boxes of any size and heading in cells of 7 m, each full of points of its own, and ground around them."""
    cells = draw(st.lists(st.tuples(st.integers(-2, 7), st.integers(-4, 4)), max_size=6, unique=True))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    boxes, points = [], []
    for index, (column, row) in enumerate(cells):
        size = rng.uniform((0.5, 0.5, 1.0), (4.5, 2.0, 2.0))
        yaw = draw(st.one_of(st.sampled_from([-math.pi, math.pi, math.pi / 2, 0.0]), st.floats(-math.pi, math.pi)))
        yaw = float(np.clip(np.float32(yaw), np.float32(-3.1415925), np.float32(3.1415925)))
        box = [7 * column + rng.uniform(-1, 1), 7 * row + rng.uniform(-1, 1), rng.uniform(-1.5, 0), *size, yaw]
        inside = FrameChange.turn(yaw).points(rng.uniform(-0.45, 0.45, (POINTS_PER_BOX, 3)) * size)
        points.append(np.column_stack([inside + box[:3], np.full(POINTS_PER_BOX, (index + 1) / 100)]))
        boxes.append(box)
    array = np.array(boxes, np.float32).reshape(-1, 7)
    ground = rng.uniform((-20, -35, -2, 0.5), (60, 35, -1.5, 1.0), (200, 4)).astype(np.float32)
    ground = ground[~points_in_boxes(ground, array, margin_m=0.05).any(axis=1)]
    cloud = rng.permutation(np.concatenate([ground, *points]).astype(np.float32))
    return LabeledFrame("000007", cloud, array, np.arange(len(array)) % 4 - 1)


def assert_objects_kept(before: LabeledFrame, after: LabeledFrame, mirrored: bool = False, factor: float = 1.0) -> None:
    """Every box has its own points where they were in it, and a yaw in [-pi, pi)."""
    assert len(after.boxes) == len(before.boxes) and np.array_equal(after.labels, before.labels)
    np.testing.assert_allclose(after.boxes[:, 3:6], factor * before.boxes[:, 3:6], rtol=1e-6)
    assert (after.boxes[:, 6] >= -math.pi).all() and (after.boxes[:, 6].astype(np.float64) < math.pi).all()
    for index, (old, new) in enumerate(zip(before.boxes, after.boxes, strict=True)):
        expected = local(points_of(before, index), old) * factor
        if mirrored:
            expected[:, 1] *= -1
        np.testing.assert_allclose(local(points_of(after, index), new), expected, atol=1e-4)
        assert points_in_boxes(points_of(after, index), after.boxes)[:, index].all()


@settings(max_examples=20)
@given(frames(), st.floats(-2 * math.pi, 2 * math.pi), st.booleans(), st.floats(0.5, 2.0))
def test_flip_rotation_and_scaling(frame: LabeledFrame, angle_rad: float, numpy_scalar: bool, factor: float) -> None:
    flipped, turned, scaled = (copy.deepcopy(frame) for _ in range(3))
    flip_y(flipped)
    assert_objects_kept(frame, flipped, mirrored=True)
    assert np.array_equal(flipped.points, frame.points * np.array([1, -1, 1, 1], np.float32))
    rotate(turned, np.float64(angle_rad) if numpy_scalar else angle_rad)
    assert_objects_kept(frame, turned)
    x, y = frame.points[:, :2].astype(np.float64).T
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    np.testing.assert_allclose(turned.points[:, :2], np.stack([cos * x - sin * y, sin * x + cos * y], 1), atol=2e-5)
    assert np.array_equal(turned.points[:, 2:], frame.points[:, 2:])
    scale(scaled, factor)
    assert_objects_kept(frame, scaled, factor=factor)
    np.testing.assert_allclose(scaled.points, frame.points * [factor, factor, factor, 1], rtol=1e-6)


@pytest.mark.parametrize("kind", [float, np.float64])
@pytest.mark.parametrize("angle_rad", [math.pi, -math.pi, np.nextafter(math.pi, 0), math.pi - 1e-8])
def test_half_a_turn_ends_below_pi(angle_rad: float, kind: type) -> None:
    """The float32 next to pi lies above it: no yaw may round to it."""
    turned = frame_of(np.zeros(7))
    rotate(turned, kind(angle_rad))
    assert -math.pi <= float(turned.boxes[0, 6]) < math.pi


@settings(max_examples=20)
@given(frames(), st.integers(0, 2**32 - 1), st.floats(0, 1.5), st.floats(0, math.pi))
def test_moved_objects(frame: LabeledFrame, seed: int, shift_m: float, turn_rad: float) -> None:
    moved = copy.deepcopy(frame)
    config = AugmentConfig(object_shift_m=shift_m, object_rotation_rad=turn_rad)
    move_objects(moved, config, np.random.default_rng(seed))
    assert_objects_kept(frame, moved)
    shared = bev_intersection(moved.boxes, moved.boxes)
    assert not shared[~np.eye(len(shared), dtype=bool)].any()
    background = frame.points[:, 3] >= 0.5
    assert np.array_equal(moved.points[background], frame.points[background])
    if shift_m == turn_rad == 0:
        assert np.array_equal(moved.boxes, frame.boxes)


def frame_of(boxes: object, points: object = ()) -> LabeledFrame:
    array = np.array(boxes, np.float32).reshape(-1, 7)
    return LabeledFrame("0", np.array(points, np.float32).reshape(-1, 4), array, np.zeros(len(array), np.int64))


def test_objects_move_as_far_as_asked() -> None:
    box = np.array([20, 3, -1, 4, 2, 1.5, 0.5], np.float32)
    config, rng = AugmentConfig(object_shift_m=0.3, object_rotation_rad=0.2), np.random.default_rng(0)
    moved = [frame_of(box) for _ in range(400)]
    for frame in moved:
        move_objects(frame, config, rng)
    differences = np.array([frame.boxes[0] - box for frame in moved])
    shifts, turns = differences[:, :3], differences[:, 6]
    # Normal with sigma 0.3 along each axis; uniform within 0.2, whose standard deviation is 0.2 / sqrt(3).
    np.testing.assert_allclose(np.std(shifts, axis=0), 0.3, rtol=0.15)
    np.testing.assert_allclose(np.mean(shifts, axis=0), 0, atol=0.06)
    assert 0.19 < np.abs(turns).max() <= 0.2001 and np.std(turns) == pytest.approx(0.2 / math.sqrt(3), rel=0.15)


def test_objects_in_a_crowd_do_not_collide() -> None:
    """Nine people 0.3 m apart, drawn to shift by as much as their own size: some draws collide, none is taken."""
    x, y = np.meshgrid([10.0, 10.9, 11.8], [-0.9, 0.0, 0.9])
    boxes = np.column_stack([x.ravel(), y.ravel(), np.tile([-0.8, 0.6, 0.6, 1.7, 0.1], (9, 1))]).astype(np.float32)
    moves = 0
    for seed in range(10):
        frame = frame_of(boxes)
        config = AugmentConfig(object_shift_m=0.5, object_rotation_rad=1.0)
        move_objects(frame, config, np.random.default_rng(seed))
        shared = bev_intersection(frame.boxes, frame.boxes)
        assert not shared[~np.eye(9, dtype=bool)].any()
        moves += int((frame.boxes != boxes).any(axis=1).sum())
    assert 50 < moves <= 90


def test_points_of_overlapping_boxes_are_not_torn_off() -> None:
    """A point in two labelled boxes goes with the first; the second, when it moves, does not take it away again."""
    points = [[11, 0.75, 0.5, 0.01], [9, -0.5, 0, 0.01], [9, 2.0, 0, 0.02]]
    frame = frame_of([[10, 0, 0, 4, 2, 2, 0], [10, 1.5, 0, 4, 2, 2, 0]], points)
    before = copy.deepcopy(frame)
    move_objects(frame, AugmentConfig(object_shift_m=1.5), np.random.default_rng(1))
    assert (frame.boxes != before.boxes).any(axis=1).all()
    assert_objects_kept(before, frame)


@settings(max_examples=20)
@given(frames(), st.integers(0, 2**32 - 1))
def test_augmented_objects_keep_their_points(frame: LabeledFrame, seed: int) -> None:
    points, boxes = frame.points.copy(), frame.boxes.copy()
    for array in (frame.points, frame.boxes, frame.labels):
        array.flags.writeable = False
    after = augment(frame, STRONG, np.random.default_rng(seed))
    assert np.array_equal(frame.points, points) and np.array_equal(frame.boxes, boxes)
    again = augment(frame, STRONG, np.random.default_rng(seed))
    assert np.array_equal(after.points, again.points) and np.array_equal(after.boxes, again.boxes)

    assert after.frame_id == "000007"
    assert after.points.dtype == after.boxes.dtype == np.float32
    assert np.array_equal(after.points[:, 3], frame.points[:, 3])
    if len(boxes):
        factor = float(after.boxes[0, 3] / boxes[0, 3])
        old = local(points_of(frame, 0), boxes[0])[:, 1]
        mirrored = float(old @ local(points_of(after, 0), after.boxes[0])[:, 1]) < 0
        assert 0.8 <= factor <= 1.25
        assert_objects_kept(frame, after, mirrored=mirrored, factor=factor)


def test_seeds_differ_and_half_are_mirrored() -> None:
    points, boxes, _ = make_scene(0)
    frame = frame_of(boxes, points)
    assert np.array_equal(augment(frame, STILL, np.random.default_rng(0)).points, points), "nothing is asked"
    results = [augment(frame, replace(STILL, flip_probability=0.5), np.random.default_rng(seed)) for seed in range(100)]
    mirrored = [bool(np.array_equal(result.points[:, 1], -points[:, 1])) for result in results]
    plain = [bool(np.array_equal(result.points, points)) for result in results]
    assert mirrored == [not same for same in plain] and 30 < sum(mirrored) < 70
    first, second = (augment(frame, AugmentConfig(), np.random.default_rng(seed)) for seed in (1, 2))
    assert not np.array_equal(first.points, second.points) and not np.array_equal(first.boxes, second.boxes)


def test_what_is_ahead_is_put_behind_in_the_share_that_is_asked_for() -> None:
    points, boxes, _ = make_scene(0)
    frame = frame_of(boxes, points)
    config = replace(STILL, flip_x_probability=0.3)
    results = [augment(frame, config, np.random.default_rng(seed)) for seed in range(100)]
    behind = [result for result in results if not np.array_equal(result.points, points)]
    assert 15 < len(behind) < 45
    for result in behind:
        np.testing.assert_allclose(result.points, points * np.array([-1, 1, 1, 1], np.float32), atol=1e-5)
        assert_objects_kept(frame, result, mirrored=True)


@pytest.mark.parametrize(
    ("name", "value", "low", "high"),
    [("rotation_rad", 0.3, -0.3, 0.3), ("scale", (0.9, 1.3), 0.9, 1.3), ("shift_z_m", 0.2, -0.2, 0.2)],
)
def test_draws_fill_their_bounds(name: str, value: object, low: float, high: float) -> None:
    frame, rng = frame_of([10, 0, 0, 1, 1, 1, 0], [10, 0, 0, 0.5]), np.random.default_rng(0)
    config = replace(STILL, **{name: value})  # type: ignore[arg-type]
    boxes = np.array([augment(frame, config, rng).boxes[0] for _ in range(200)])
    drawn = {"rotation_rad": boxes[:, 6], "scale": boxes[:, 3], "shift_z_m": boxes[:, 2]}
    values = drawn.pop(name)
    assert low - 1e-6 <= values.min() < low + 0.05 * (high - low)
    assert high - 0.05 * (high - low) < values.max() <= high + 1e-6
    assert all(np.ptp(others) == 0 for others in drawn.values())


def test_the_share_of_dropped_points_is_itself_drawn() -> None:
    """Between 0 and `point_dropout`, so half of that on average; boxes stay, the kept points keep their order."""
    points = np.random.default_rng(0).uniform(-20, 20, (4000, 4)).astype(np.float32)
    points[:, 3] = np.arange(4000) / 4000
    frame, shares = frame_of(make_scene(2)[1], points), []
    for seed in range(60):
        after = augment(frame, replace(STILL, point_dropout=0.6), np.random.default_rng(seed))
        assert np.array_equal(after.boxes, frame.boxes)
        assert np.array_equal(after.points, points[np.isin(points[:, 3], after.points[:, 3])])
        shares.append(1 - len(after.points) / 4000)
    # 0.6 / sqrt(12) = 0.17 is the spread of the draw; 60 draws tell the mean to 0.022.
    assert min(shares) < 0.1 and 0.5 < max(shares) < 0.63 and np.mean(shares) == pytest.approx(0.3, abs=0.08)


@pytest.mark.parametrize(("points", "boxes"), [(0, 0), (0, 2), (5, 0)])
def test_empty_frames(points: int, boxes: int) -> None:
    cloud, array, _ = make_scene(3)
    strong = replace(STRONG, point_dropout=0.3, flip_probability=1)
    after = augment(frame_of(array[:boxes], cloud[:points]), strong, np.random.default_rng(0))
    assert after.points.shape[1:] == (4,) and len(after.points) <= points and after.boxes.shape == (boxes, 7)


# --- corruption: of the points of objects only, within what was asked for


POINTS, BOXES, _ = make_scene(3)
INSIDE = points_in_boxes(POINTS, BOXES)


def corrupting(**changes: object) -> AugmentConfig:
    return dataclasses.replace(AugmentConfig(), **changes)  # type: ignore[arg-type]


def corrupted(seed: int, points: NDArray[np.float32] = POINTS, **changes: object) -> NDArray[np.float32]:
    return corrupt_objects(points, BOXES, corrupting(**changes), np.random.default_rng(seed))


def test_off_draws_nothing() -> None:
    rng = np.random.default_rng(0)
    assert corrupt_objects(POINTS, BOXES, AugmentConfig(), rng) is POINTS
    points = POINTS.copy()
    change_reflectance(points, AugmentConfig(), rng)
    assert np.array_equal(points, POINTS)
    assert rng.bit_generator.state == np.random.default_rng(0).bit_generator.state


def test_gains_are_one_for_each_object_and_halve_as_often_as_they_double() -> None:
    before = POINTS.copy()
    found = corrupted(1, object_reflectance_gain=(0.5, 2.0))
    assert np.array_equal(POINTS, before) and np.array_equal(found[:, :3], POINTS[:, :3])
    assert np.array_equal(found[~INSIDE.any(axis=1)], POINTS[~INSIDE.any(axis=1)])
    gains = []
    for own in INSIDE.T:
        lower = own & (POINTS[:, 3] < 0.45)  # twice as much is not cut off at 1
        ratio = found[lower, 3] / POINTS[lower, 3]
        assert np.ptp(ratio) < 1e-5 and 0.5 <= ratio[0] <= 2
        gains.append(ratio[0])
    assert len(set(np.round(gains, 4))) == len(BOXES) and found[:, 3].max() <= 1
    dark = POINTS.copy()
    dark[:, 3] = 0.1
    gains = [corrupted(s, dark, object_reflectance_gain=(0.5, 2.0))[INSIDE[:, 0], 3][0] / 0.1 for s in range(300)]
    assert np.mean(np.array(gains) > 1) == pytest.approx(0.5, abs=0.1)


def test_jitter_has_its_standard_deviation_and_few_points_are_not_cut() -> None:
    found = corrupted(2, object_jitter_m=0.015)
    moved = INSIDE.any(axis=1)
    assert np.array_equal(found[~moved], POINTS[~moved]) and np.array_equal(found[:, 3], POINTS[:, 3])
    difference = (found - POINTS)[moved, :3]
    assert difference.std() == pytest.approx(0.015, rel=0.1) and abs(difference.mean()) < 0.002
    few = np.concatenate([POINTS[INSIDE[:, 0]][:FEWEST_POINTS], POINTS[~INSIDE.any(axis=1)]])
    for seed in range(20):
        assert len(corrupted(seed, few, object_cut_probability=1.0)) == len(few)
    nothing = corrupted(0, np.empty((0, 4), np.float32), object_cut_probability=1.0, object_jitter_m=0.1)
    assert nothing.shape == (0, 4)


def test_a_cut_takes_a_sector_or_rings_as_seen_from_the_sensor() -> None:
    taken = {"azimuth": 0, "elevation": 0}
    for seed in range(20):
        found = corrupted(seed, object_cut_probability=1.0)
        gone = ~np.isin(POINTS.view("V16").ravel(), np.ascontiguousarray(found).view("V16").ravel())
        assert not gone[~INSIDE.any(axis=1)].any()
        for own in INSIDE.T:
            if not gone[own].any():
                continue
            x, y, z, _ = POINTS[own].astype(np.float64).T
            angles = {"azimuth": np.arctan2(y, x), "elevation": np.arctan2(z, np.hypot(x, y))}
            cut = gone[own]
            assert (~cut).sum() >= FEWEST_POINTS
            # Nothing that stays lies inside the range of what is gone, in one of the two angles.
            clean = {
                name: not ((angle > angle[cut].min()) & (angle < angle[cut].max()))[~cut].any()
                for name, angle in angles.items()
            }
            assert any(clean.values())
            for name in taken:
                taken[name] += clean[name]
    assert min(taken.values()) > 10


def test_reflectance_is_lost_in_part_or_is_one_value() -> None:
    some = constant = same = 0
    bright = POINTS.copy()
    bright[:, 3] = np.linspace(0.2, 0.9, len(bright))
    for seed in range(200):
        points = bright.copy()
        change_reflectance(points, corrupting(reflectance_loss_probability=0.5), np.random.default_rng(seed))
        assert np.array_equal(points[:, :3], bright[:, :3])
        same += np.array_equal(points, bright)
        constant += np.ptp(points[:, 3]) == 0
        some += bool((points[:, 3] == 0).any() and np.isin(points[:, 3], [0, *bright[:, 3]]).all())
    assert same == pytest.approx(100, abs=25) and constant == pytest.approx(50, abs=20)
    assert some == pytest.approx(50, abs=20)


def test_all_points_have_one_gain() -> None:
    before = POINTS.copy()
    before[:, 3] = np.linspace(0, 0.6, len(before))
    gains = []
    for seed in range(300):
        points = before.copy()
        change_reflectance(points, corrupting(reflectance_gain=(0.5, 2.0)), np.random.default_rng(seed))
        assert np.array_equal(points[:, :3], before[:, :3]) and points[:, 3].max() <= 1
        gain = points[1, 3] / before[1, 3]
        np.testing.assert_allclose(points[:, 3], np.minimum(before[:, 3] * gain, 1), rtol=1e-5)
        gains.append(gain)
    assert min(gains) == pytest.approx(0.5, abs=0.05) and max(gains) == pytest.approx(2, abs=0.1)
    assert np.mean(np.array(gains) > 1) == pytest.approx(0.5, abs=0.1)


def test_a_frame_gets_the_gain() -> None:
    points, boxes, _ = make_scene(0)
    frame = frame_of(boxes, points)
    found = augment(frame, replace(STILL, reflectance_gain=(0.5, 0.5)), np.random.default_rng(0))
    np.testing.assert_allclose(found.points, frame.points * [1, 1, 1, 0.5], rtol=1e-6)


def test_a_cut_is_that_of_the_sensor_wherever_the_origin_is() -> None:
    """Points of a vehicle's frame, whose sensor stands on its roof, lose what those of the sensor's own frame lose."""
    cut, sensor_m = corrupting(object_cut_probability=1.0), (1.5, 0.25, 2.0)
    boxes = BOXES + np.array([0, 0, 0, 0.02, 0.02, 0.02, 0], np.float32)  # no point on a face
    lifted = POINTS + np.array([*sensor_m, 0], np.float32), boxes + np.array([*sensor_m, 0, 0, 0, 0], np.float32)
    for seed in range(6):
        own = corrupt_objects(POINTS, boxes, cut, np.random.default_rng(seed))
        found = corrupt_objects(*lifted, cut, np.random.default_rng(seed), sensor_m)
        from_the_origin = corrupt_objects(*lifted, cut, np.random.default_rng(seed))
        assert abs(len(found) - len(own)) <= 1 < abs(len(from_the_origin) - len(own))
