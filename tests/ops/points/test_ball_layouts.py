"""Grouped and gathered balls against the rows of `ball_query`."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_pillars.ops.points.ball_layouts import gather_balls, group_balls, group_widths
from asca_pillars.ops.points.neighbors import ball_query
from tests.ops.points.clouds import CLOUDS

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
