"""Rotation matrices against scipy's, about every axis; transformed points against the matrix product."""

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from asca_pillars.geometry.boxes import footprints, points_in_boxes, wrap_angle
from asca_pillars.geometry.frame_change import (
    FrameChange,
    rotations_from_quaternions,
    rotations_from_roll_pitch_yaw,
    transform_columns,
    transform_points,
)
from tests.geometry.drawn_boxes import random_boxes

angles = st.floats(-10, 10)
shifts = st.tuples(*[st.floats(-50, 50)] * 3)


def change(angle: float, shift: tuple[float, ...], mirror: bool) -> FrameChange:
    axes = Rotation.from_euler("z", angle).as_matrix() @ np.diag([1, -1 if mirror else 1, 1])
    return FrameChange(axes, np.array(shift))


@settings(max_examples=40)
@given(angles, shifts, st.booleans(), st.integers(0, 2**32 - 1))
def test_boxes_move_with_their_corners_and_points_and_back(
    angle: float, shift: tuple[float, ...], mirror: bool, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    boxes, there = random_boxes(seed, 4), change(angle, shift, mirror)
    flat = np.insert(footprints(boxes.astype(np.float64)), 2, boxes[:, None, 2], axis=2).reshape(-1, 3)
    moved = there.points(flat).reshape(4, 4, 3)[..., :2]
    if mirror:  # left and right are exchanged, the front stays the front
        moved = moved[:, [3, 2, 1, 0]]
    np.testing.assert_allclose(footprints(there.boxes(boxes)), moved, atol=1e-3)
    points = (boxes[rng.integers(0, 4, 30), :3] + rng.normal(0, 1, (30, 3))).astype(np.float32)
    clearly = points_in_boxes(points, boxes, 0.01) == points_in_boxes(points, boxes, -0.01)
    held = points_in_boxes(there.points(points), there.boxes(boxes))
    assert (held == points_in_boxes(points, boxes))[clearly].all()
    np.testing.assert_allclose(there.inverse.points(there.points(points)), points, atol=1e-4)
    back = there.inverse.boxes(there.boxes(boxes))
    np.testing.assert_allclose(back[:, :6], boxes[:, :6], atol=1e-4)
    np.testing.assert_allclose(wrap_angle(back[:, 6] - boxes[:, 6]), 0, atol=1e-4)


@pytest.mark.parametrize("quarters", range(-5, 6))
def test_quarter_turns_are_exact(quarters: int) -> None:
    points = np.random.default_rng(1).uniform(-60, 60, (50, 4)).astype(np.float32)
    expected = points.copy()
    for _ in range(quarters % 4):
        expected[:, :2] = np.stack([-expected[:, 1], expected[:, 0]], axis=1)
    np.testing.assert_array_equal(FrameChange.turn(quarters * np.pi / 2).points(points), expected)


def test_identity() -> None:
    assert FrameChange.turn(0).is_identity
    assert not FrameChange.turn(0.1).is_identity
    assert not FrameChange(np.eye(3), np.array([0, 0, 0.1])).is_identity


quaternions = st.tuples(*[st.floats(-2, 2)] * 4)
roll_pitch_yaw = st.tuples(*[st.floats(-7, 7)] * 3)


@given(st.lists(quaternions, min_size=1, max_size=4), st.lists(roll_pitch_yaw, min_size=1, max_size=4))
def test_quaternions_have_the_real_part_first_and_roll_comes_before_yaw(
    quaternions: list[tuple[float, ...]], roll_pitch_yaw: list[tuple[float, ...]]
) -> None:
    """Quaternions may have any length; roll, pitch and yaw turn about axes that stand still."""
    assume(all(np.linalg.norm(one) > 1e-3 for one in quaternions))
    turned = (
        Rotation.from_quat(np.array(quaternions)[:, [1, 2, 3, 0]]),
        Rotation.from_euler("xyz", np.array(roll_pitch_yaw)),
    )
    ours = rotations_from_quaternions, rotations_from_roll_pitch_yaw
    for function, drawn, expected in zip(ours, (quaternions, roll_pitch_yaw), turned, strict=True):
        np.testing.assert_allclose(function(np.array(drawn)), expected.as_matrix(), atol=1e-12)
        np.testing.assert_allclose(function(np.array(drawn[0])), expected.as_matrix()[0], atol=1e-12)


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (np.nan, 0, 0, 1), (np.inf, 0, 0, 1), (1e200, 0, 0, 1e200)])
def test_what_is_no_rotation_does_not_look_like_one(quaternion: tuple[float, ...]) -> None:
    rotations = rotations_from_quaternions(np.array([quaternion, (1, 0, 0, 0)]))
    assert np.isnan(rotations[0]).all() and rotations[1].tolist() == np.eye(3).tolist()


@given(st.integers(0, 3), st.integers(1, 3), st.integers(1, 3), st.sampled_from([np.float32, np.float64]))
def test_points_are_transformed_as_by_a_product(count: int, given_axes: int, axes: int, kind: type) -> None:
    rng = np.random.default_rng(count)
    points: NDArray[Any] = rng.uniform(-60, 60, (count, given_axes)).astype(kind)
    matrix, shift = rng.normal(size=(axes, given_axes)), rng.normal(size=axes)
    expected = points.astype(np.float64) @ matrix.T
    for found, added in ((transform_points(points, matrix, shift), shift), (transform_points(points, matrix), 0.0)):
        assert found.dtype == kind and found.shape == (count, axes)
        np.testing.assert_allclose(found, expected + added, rtol=1e-5, atol=1e-4)
    np.testing.assert_array_equal(transform_columns(points.T, matrix, shift), transform_points(points, matrix, shift).T)


@pytest.mark.parametrize("count", [0, 1, 5])
def test_points_are_transformed_in_place(count: int) -> None:
    points = np.random.default_rng(1).uniform(-60, 60, (count, 4)).astype(np.float32)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    expected = np.stack([-points[:, 1], points[:, 0], points[:, 2], points[:, 3]], axis=1)
    transform_points(points[:, :3], turn, out=points[:, :3])
    np.testing.assert_array_equal(points, expected)
