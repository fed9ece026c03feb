"""Frames of boxes and the points of their grids."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asca_pillars.geometry.boxes import corners, points_in_boxes, wrap_angle
from asca_pillars.ops.two_stage.rois import (
    boxes_from_frames,
    boxes_in_frames,
    from_box_frames,
    roi_grid_points,
    to_box_frames,
)
from tests.ops.points.boxes_near import CHANGES, PROPOSALS, changed


@given(PROPOSALS, st.integers(1, 6))
def test_grid_points_fill_their_box(box: np.ndarray, size: int) -> None:
    (grid,) = roi_grid_points(box[None], size)
    assert grid.shape == (size**3, 3)
    assert points_in_boxes(grid, box[None]).all()
    np.testing.assert_allclose(grid.mean(axis=0), box[:3], atol=1e-6)
    (seen,) = to_box_frames(grid[None], box[None])
    # Cells are as large as the box over `size`, and the outer ones end at its faces.
    np.testing.assert_allclose(2 * seen.max(axis=0), box[3:6] * (size - 1) / size, atol=1e-6)


def test_z_varies_fastest() -> None:
    (grid,) = roi_grid_points(np.array([[0.0, 0, 0, 4, 2, 8, 0]]), 2)
    assert grid[:3].tolist() == [[-1, -0.5, -2], [-1, -0.5, 2], [-1, 0.5, -2]]
    assert grid[4].tolist() == [1, -0.5, -2]


@given(PROPOSALS, st.integers(0, 2**32 - 1))
def test_frames_of_points_round_trip(box: np.ndarray, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-50, 50, (1, 20, 3))
    seen = to_box_frames(points, box[None])
    np.testing.assert_allclose(from_box_frames(seen, box[None]), points, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(seen[0], axis=1), np.linalg.norm(points[0] - box[:3], axis=1))


@given(PROPOSALS, CHANGES)
def test_frames_of_boxes(frame: np.ndarray, change: tuple[np.ndarray, np.ndarray, float]) -> None:
    box = changed(frame, change)
    seen = boxes_in_frames(box[None], frame[None])
    # The corners of the box as seen are the corners, as seen.
    np.testing.assert_allclose(corners(seen)[0], to_box_frames(corners(box[None]), frame[None])[0], atol=1e-9)
    back = boxes_from_frames(seen, frame[None])[0]
    np.testing.assert_allclose(back[:6], box[:6], atol=1e-9)
    assert wrap_angle(back[6] - box[6]) == pytest.approx(0, abs=1e-9)


def test_no_boxes() -> None:
    assert roi_grid_points(np.empty((0, 7), np.float32), 6).shape == (0, 216, 3)
    assert math.prod(to_box_frames(np.empty((0, 4, 3)), np.empty((0, 7))).shape) == 0
