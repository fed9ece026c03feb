"""The plane that most points lie on, against planes that are known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_pillars.geometry.common_plane import _least_squares, most_common_plane, plane_heights

SLOPES = st.floats(-0.25, 0.25)


def on_plane(rng: np.random.Generator, plane: tuple[float, float, float], count: int) -> np.ndarray:
    xy = rng.uniform((0, -30), (40, 30), (count, 2))
    return np.column_stack([xy, xy @ plane[:2] + plane[2] + rng.normal(0, 0.02, count)])


@settings(max_examples=50, deadline=None)
@given(SLOPES, SLOPES, st.floats(-3, 1), st.floats(0.1, 0.6), st.integers(0, 99))
def test_a_plane_is_found_among_walls_and_outliers(a: float, b: float, c: float, clutter: float, seed: int) -> None:
    """Up to six tenths of the points are no ground: half of these on two walls, half anywhere above."""
    rng = np.random.default_rng(seed)
    points = on_plane(rng, (a, b, c), 1000)
    wall, high = np.array_split(rng.permutation(1000)[: int(1000 * clutter)], 2)
    points[wall, 1] = rng.choice([-12.0, 15.0], len(wall))
    points[wall, 2] = points[wall, :2] @ (a, b) + c + rng.uniform(0, 4, len(wall))
    points[high, 2] += rng.uniform(0.3, 6, len(high))
    found = most_common_plane(points, 0.15, max_slope=0.3)
    assert found is not None
    error = np.column_stack([points[:, :2], np.ones(1000)]) @ (found - (a, b, c))
    assert np.abs(error).max() < 0.08


def test_of_two_levels_the_one_with_more_points_each_time() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([on_plane(rng, (0, 0, -1.7), 600), on_plane(rng, (0, 0, 1.0), 400)])
    found = most_common_plane(points, 0.1)
    assert found is not None and found == pytest.approx((0, 0, -1.7), abs=0.01)
    assert np.array_equal(found, np.array(most_common_plane(points.copy(), 0.1)))


def test_points_without_a_plane_and_points_in_a_line() -> None:
    line = np.linspace((0, 0, -1.7), (30, 30, -1.5), 100)
    steep = on_plane(np.random.default_rng(0), (0.5, 0, -5), 100)
    assert most_common_plane(np.zeros((0, 3)), 0.1) is None
    assert most_common_plane(line, 0.1) is None
    assert most_common_plane(steep, 0.1, max_slope=0.3) is None
    assert most_common_plane(steep, 0.1) == pytest.approx((0.5, 0, -5), abs=0.02)
    assert _least_squares(*np.linspace((0, 0, 1), (3, 5, 2), 9).T) is None
    assert _least_squares(*np.zeros((3, 2))) is None


@given(SLOPES, SLOPES, st.floats(-3, 1), st.integers(3, 60))
def test_the_plane_of_least_squares_is_numpys(a: float, b: float, c: float, count: int) -> None:
    points = on_plane(np.random.default_rng(count), (a, b, c), count)
    design = np.column_stack([points[:, :2], np.ones(count)])
    expected = np.linalg.lstsq(design, points[:, 2], rcond=None)[0]
    found = _least_squares(*points.T)
    assert found is not None
    np.testing.assert_allclose(found, expected, atol=1e-8)
    np.testing.assert_allclose(plane_heights(found, points), design @ expected, atol=1e-8)
