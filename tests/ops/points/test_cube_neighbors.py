"""The points nearest to the cells of cubes against all distances."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_pillars.ops.points.neighbors import cube_cells_m, nearest_in_cubes
from tests.ops.numpy_kernels import both_forms
from tests.ops.points.clouds import CLOUDS


@given(CLOUDS, CLOUDS, st.sampled_from([0.05, 0.8, 1.6, 40.0]), st.integers(1, 3))
@settings(max_examples=40)
def test_nearest_in_cubes(points: np.ndarray, queries: np.ndarray, half_length_m: float, cells: int) -> None:
    queries = queries[:8]
    compiled, in_numpy = both_forms(nearest_in_cubes, points, queries, half_length_m, cells)
    assert compiled.dtype == in_numpy.dtype == np.int32
    assert compiled.shape == (len(queries), cells**3, 3) and (compiled == in_numpy).all()
    places = queries[:, None, :3] + cube_cells_m(half_length_m, cells)
    for query, at, rows in zip(queries[:, :3], places, compiled, strict=True):
        near = np.flatnonzero((np.abs(points[:, :3] - query) < np.float32(2 * half_length_m)).all(axis=1))
        there = min(len(near), 3)
        squared = ((points[near, :3] - at[:, None]) ** 2).sum(axis=2)
        assert (rows[:, :there] == near[np.argsort(squared, axis=1, kind="stable")[:, :there]]).all()
        assert (rows[:, there:] == len(points)).all()


def test_cells_of_a_cube() -> None:
    centers = cube_cells_m(1.5, 3)
    assert centers.shape == (27, 3)
    np.testing.assert_allclose(
        centers[[0, 1, 3, 9, 13]], [[-1, -1, -1], [-1, -1, 0], [-1, 0, -1], [0, -1, -1], [0] * 3]
    )


def test_what_is_no_point() -> None:
    with pytest.raises(ValueError, match="finite"):
        nearest_in_cubes(np.full((1, 3), np.nan), np.zeros((1, 3)), 0.8, 3)
