import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from asca_pillars.geometry.boxes import footprints, points_in_boxes, wrap_angle
from asca_pillars.geometry.frame_change import FrameChange
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
