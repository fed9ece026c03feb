"""Balls and nearest points against all distances."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asca_pillars.ops.points.neighbors import ball_query, three_nearest
from tests.ops.numpy_kernels import both_forms
from tests.ops.points.clouds import CLOUDS, cloud

RADII = st.sampled_from([0.05, 0.4, 1.0, 2.5, 50.0])


def distances(points: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """(Q, N) squared, float32, added up in the order x, y, z."""
    d = points[None, :, :3] - queries[:, None, :3]
    return d[..., 0] * d[..., 0] + d[..., 1] * d[..., 1] + d[..., 2] * d[..., 2]


@given(CLOUDS, CLOUDS, RADII, st.integers(1, 20))
def test_balls(points: np.ndarray, queries: np.ndarray, radius_m: float, samples: int) -> None:
    compiled, in_numpy = both_forms(ball_query, points, queries, radius_m, samples)
    assert compiled.dtype == in_numpy.dtype == np.int32
    assert (compiled == in_numpy).all()
    assert compiled.shape == (len(queries), samples)
    inside = distances(points, queries) < np.float32(radius_m) ** 2
    for row, members in zip(compiled, inside, strict=True):
        found = row[row < len(points)]
        if not members.any():
            assert not len(found)
            continue
        assert len(found) == samples
        different = np.unique(found)
        assert len(different) == min(samples, members.sum())
        assert members[different].all()
        assert (found[len(different) :] == found[0]).all()


def test_what_fits_is_found_whatever_the_order_of_the_points() -> None:
    points, queries = cloud(0, 300, 3.0, coarse=False), cloud(1, 50, 3.0, coarse=False)
    order = np.random.default_rng(2).permutation(len(points))
    one, other = ball_query(points, queries, 1.5, 300), ball_query(points[order], queries, 1.5, 300)
    padded = np.append(order, len(points))
    for row, shuffled in zip(one, other, strict=True):
        assert set(row) == set(padded[shuffled])


def test_a_full_ball_is_not_filled_from_one_side() -> None:
    # Dense points in the order of storage of a scan, ring by ring: PointNet++ would take those of the smallest y alone.
    x, y = np.meshgrid(np.arange(-1, 1, 0.02), np.arange(-1, 1, 0.02))
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1).astype(np.float32)
    (row,) = ball_query(points, np.zeros((1, 3), np.float32), 0.8, 64)
    quadrants = np.bincount((points[row, 0] > 0) * 2 + (points[row, 1] > 0), minlength=4)
    assert quadrants.min() > 0


@given(CLOUDS, CLOUDS)
def test_three_nearest(points: np.ndarray, queries: np.ndarray) -> None:
    (indices, weights), (in_numpy, numpy_weights) = both_forms(three_nearest, points, queries)
    assert (indices == in_numpy).all()
    assert weights.tobytes() == numpy_weights.tobytes()
    there = min(3, len(points))
    expected = np.argsort(distances(points, queries), axis=1, kind="stable")[:, :there]
    assert (indices[:, :there] == expected).all()
    assert (indices[:, there:] == len(points)).all()
    assert (weights[:, there:] == 0).all()
    if there:
        np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=1e-5)
        assert (np.diff(weights, axis=1) <= 1e-6).all()


def test_weights_are_inverse_distances() -> None:
    points = np.array([[1, 0, 0], [0, 2, 0], [0, 0, 4], [9, 9, 9]], np.float32)
    _, weights = three_nearest(points, np.zeros((1, 3), np.float32))
    assert weights[0] == pytest.approx([4 / 7, 2 / 7, 1 / 7])
    _, weights = three_nearest(points, points[:1])
    assert weights[0] == pytest.approx([1, 0, 0], abs=1e-6)
