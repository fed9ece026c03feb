"""Balls, nearest points and the cells of cubes against all distances.

Grouped and gathered balls against the rows of `ball_query`.
"""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_pillars.ops.points.neighbors import (
    ball_query,
    cube_cells_m,
    gather_balls,
    group_balls,
    group_widths,
    nearest_in_cubes,
    three_nearest,
)
from tests.ops.numpy_kernels import by_numpy
from tests.ops.points.clouds import CLOUDS, squared_distances


@settings(max_examples=40)
@given(CLOUDS, CLOUDS, st.sampled_from([0.05, 0.4, 1.0, 2.5, 50.0]), st.integers(1, 20))
def test_balls(points: np.ndarray, queries: np.ndarray, radius_m: float, samples: int) -> None:
    found = ball_query(points, queries, radius_m, samples)
    assert found.dtype == np.int32 and found.shape == (len(queries), samples)
    np.testing.assert_array_equal(found, by_numpy(ball_query, points, queries, radius_m, samples))
    inside = squared_distances(points, queries) < np.float32(radius_m) ** 2
    for row, members in zip(found, inside, strict=True):
        if not members.any():
            assert (row == len(points)).all()
            continue
        different = np.unique(row)
        assert len(different) == min(samples, members.sum()) and members[different].all()
        assert (row[len(different) :] == row[0]).all()


def test_a_full_ball_is_not_filled_from_one_side() -> None:
    # Dense points in the order of storage of a scan, ring by ring: PointNet++ would take those of the smallest y alone.
    x, y = np.meshgrid(np.arange(-1, 1, 0.02), np.arange(-1, 1, 0.02))
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1).astype(np.float32)
    (row,) = ball_query(points, np.zeros((1, 3), np.float32), 0.8, 64)
    quadrants = np.bincount((points[row, 0] > 0) * 2 + (points[row, 1] > 0), minlength=4)
    assert quadrants.min() > 0


@settings(max_examples=50)
@given(CLOUDS, CLOUDS)
def test_three_nearest(points: np.ndarray, queries: np.ndarray) -> None:
    indices, weights = three_nearest(points, queries)
    there = min(3, len(points))
    squared = squared_distances(points, queries)
    expected = np.argsort(squared, axis=1, kind="stable")[:, :there]
    assert (indices[:, :there] == expected).all()
    assert (indices[:, there:] == len(points)).all() and (weights[:, there:] == 0).all()
    inverse = 1 / (np.sqrt(np.take_along_axis(squared, expected, axis=1)) + 1e-8)
    np.testing.assert_allclose(weights[:, :there], inverse / inverse.sum(axis=1, keepdims=True), rtol=1e-5)


@given(CLOUDS, CLOUDS, st.sampled_from([0.05, 0.8, 1.6, 40.0]), st.integers(1, 3))
@settings(max_examples=30)
def test_nearest_in_cubes(points: np.ndarray, queries: np.ndarray, half_length_m: float, cells: int) -> None:
    queries = queries[:8]
    found = nearest_in_cubes(points, queries, half_length_m, cells)
    assert found.dtype == np.int32 and found.shape == (len(queries), cells**3, 3)
    places = queries[:, None, :3] + cube_cells_m(half_length_m, cells)
    for query, at, rows in zip(queries[:, :3], places, found, strict=True):
        near = np.flatnonzero((np.abs(points[:, :3] - query) < np.float32(2 * half_length_m)).all(axis=1))
        there = min(len(near), 3)
        nearest = np.argsort(squared_distances(points[near], at), axis=1, kind="stable")[:, :there]
        assert (rows[:, :there] == near[nearest]).all() and (rows[:, there:] == len(points)).all()


def test_cells_of_a_cube() -> None:
    centers = cube_cells_m(1.5, 3)
    assert centers.shape == (27, 3)
    np.testing.assert_allclose(
        centers[[0, 1, 3, 9, 13]], [[-1, -1, -1], [-1, -1, 0], [-1, 0, -1], [0, -1, -1], [0] * 3]
    )


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_has_no_place_is_refused(bad: float) -> None:
    place, nowhere = np.zeros((1, 3)), np.array([[0, bad, 0]])
    searches: tuple[tuple[Any, ...], ...] = ((ball_query, 0.8, 3), (three_nearest,), (nearest_in_cubes, 0.8, 3))
    for search, *more in searches:
        for points, queries in ((nowhere, place), (place, nowhere)):
            with pytest.raises(ValueError, match="finite"):
                search(points, queries, *more)


RADII = st.sampled_from([0.05, 1.0, 2.5, 50.0])


def test_widths() -> None:
    assert group_widths(16) == (2, 4, 8, 12, 16)
    assert group_widths(1) == (1,)
    assert group_widths(3) == (1, 2, 3)


@settings(max_examples=25)
@given(CLOUDS, CLOUDS, RADII, st.integers(1, 20))
def test_every_ball_is_in_the_narrowest_group_with_room(
    points: np.ndarray, queries: np.ndarray, radius_m: float, samples: int
) -> None:
    indices = ball_query(points, queries, radius_m, samples)
    balls, widths = group_balls(indices, len(points)), group_widths(samples)
    members = [row for group in balls.groups for row in group.members]
    assert sorted(balls.rows.tolist()) == list(range(len(queries))) and len(members) == len(queries)
    for expected, row in zip(indices, balls.rows, strict=True):
        different = set(expected.tolist())
        assert set(members[row].tolist()) == different
        assert len(members[row]) == min(width for width in widths if width >= len(different))
    around = np.concatenate([group.queries for group in balls.groups])[balls.rows]
    empty = (indices == len(points)).all(axis=1)
    assert (around == np.where(empty, len(queries), np.arange(len(queries)))).all()
    for group, width in zip(balls.groups, widths, strict=True):
        assert group.members.shape == (len(group.queries), width)
        assert group.members.flags.c_contiguous and group.members.dtype == group.queries.dtype == np.int32


@settings(max_examples=25)
@given(CLOUDS, CLOUDS, RADII)
def test_gathered_points_are_relative_to_the_center(points: np.ndarray, queries: np.ndarray, radius_m: float) -> None:
    indices = ball_query(points, queries, radius_m, 5)
    balls = gather_balls(points, queries[:, :3], indices)
    assert balls.shape == (len(queries), 5, 4) and balls.dtype == np.float32
    there = indices < len(points)
    centers = np.insert(queries[:, :3], 3, 0, axis=1)[:, None]
    expected = np.vstack([points, np.zeros((1, 4), np.float32)])[indices] - centers
    np.testing.assert_array_equal(balls, np.where(there[..., None], expected, 0))
