"""The fitted ground against grounds that are known."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.cluster import DBSCAN

from asca_pillars.data.insertion.ground_fit import (
    CLUSTER_MIN_POINTS,
    Ground,
    cluster_boxes,
    cluster_labels,
    fit_ground,
    fit_plane,
)
from asca_pillars.geometry.boxes import points_in_boxes
from asca_pillars.scans.ground_height import plane_heights
from tests.data.insertion.simple_streets import cast, stand

SLOPES = st.floats(-0.06, 0.06)


@settings(max_examples=6)
@given(SLOPES, SLOPES, st.floats(-2.2, -1.4), st.integers(0, 9))
def test_a_tilted_plane_is_found_between_walls_and_among_clutter(a: float, b: float, c: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    plane = (a, b, c)
    cars = [stand("Car", x, y, plane=plane) for x, y in ((9, 4), (14, -4), (20, 3), (26, -2))]
    walls = [np.array([20, y, c + 2, 36, 0.4, 8, 0.1], np.float32) for y in (-9, 12)]
    points = cast(plane, np.array([*cars, *walls]))
    points[:, 2] += rng.normal(0, 0.02, len(points))
    leaves = rng.uniform((10, 8, -1), (30, 15, 3), (len(points) // 2, 3))
    found = fit_plane(np.concatenate([points[:, :3], leaves]))
    assert found is not None
    corners = np.array([[4, -9], [4, 9], [38, -9], [38, 9]])
    assert np.abs(plane_heights(found, corners) - plane_heights(np.array(plane), corners)).max() < 0.12


def test_hills_are_followed_where_a_plane_is_far_off() -> None:
    """Returns spread over waves of 40 m; a wall and a car stand on them and hide what is under them."""
    rng = np.random.default_rng(0)
    xy = rng.uniform((4, -25), (60, 25), (30_000, 2))

    def height(xy: np.ndarray) -> np.ndarray:
        return -1.7 + 0.01 * xy[:, 0] + 0.4 * np.sin(xy[:, 0] / 40 * 2 * np.pi) + 0.1 * np.cos(xy[:, 1] / 8)

    z = height(xy) + rng.normal(0, 0.02, len(xy))
    car = (np.abs(xy - (20, 3)) < (2.2, 1)).all(axis=1)
    wall = np.abs(xy[:, 1] + 15) < 0.4
    z[car] += rng.uniform(0.3, 1.5, car.sum())
    z[wall] += rng.uniform(0.0, 3.0, wall.sum())
    ground = fit_ground(np.column_stack([xy, z]))
    assert ground is not None
    where = rng.uniform((6, -22), (58, 22), (500, 2))
    error = np.abs(ground.heights(where) - height(where))
    assert np.percentile(error, 95) < 0.08 and error.max() < 0.25
    assert np.abs(height(where) - plane_heights(ground.plane, where)).max() > 0.3
    assert abs(float(ground.heights(np.array([[20.0, 3.0]]))[0] - height(np.array([[20.0, 3.0]]))[0])) < 0.15


def test_no_ground() -> None:
    """No points, a post, or a steep wall: nothing to stand on."""
    for count in (0, 3, 200):
        post = np.column_stack([np.full(count, 10.0), np.zeros(count), np.linspace(-1, 2, count)])
        assert fit_plane(post) is None and fit_ground(post) is None
    y, z = np.random.default_rng(1).uniform((-20, -1), (20, 5), (4000, 2)).T
    assert fit_ground(np.column_stack([10 + 0.5 * (z + 1), y, z])) is None


# --- clusters of obstacle points, against scikit-learn's DBSCAN


CELL_M = 0.25
GROUND = Ground(np.array([0.01, -0.02, -1.7]), np.array([-40.0, -40.0]), np.zeros((80, 80), np.float16))


@settings(max_examples=60)
@given(st.integers(0, 200), st.floats(1, 8), st.integers(0, 10_000))
def test_labels_are_those_of_dbscan(count: int, size_m: float, seed: int) -> None:
    """From lone points to one cluster; cores are told apart exactly, a point between two clusters may be of either."""
    xy = np.random.default_rng(seed).uniform(-size_m, size_m, (count, 2))
    labels = cluster_labels(xy)
    if not count:
        assert labels.shape == (0,)
        return
    cells, inverse, points = np.unique(np.floor(xy / CELL_M), axis=0, return_inverse=True, return_counts=True)
    expected = DBSCAN(eps=2.5, min_samples=CLUSTER_MIN_POINTS, metric="chebyshev").fit(cells, sample_weight=points)
    of_cell = np.zeros(len(cells), np.int64)
    of_cell[inverse.ravel()] = labels
    assert np.array_equal(of_cell[inverse.ravel()], labels)
    assert np.array_equal(of_cell > 0, expected.labels_ >= 0)
    cores = expected.core_sample_indices_
    pairs = set(zip(of_cell[cores].tolist(), expected.labels_[cores].tolist(), strict=True))
    assert len(pairs) == len({one for one, _ in pairs}) == len({other for _, other in pairs})
    for cell in np.flatnonzero(of_cell):
        near = np.abs(cells[cores] - cells[cell]).max(axis=1) <= 2
        assert of_cell[cell] in of_cell[cores][near]


def test_clusters_stand_on_the_ground_and_long_ones_are_cut() -> None:
    rng = np.random.default_rng(1)
    middles = np.array([[10.0, 3.0], [15.0, -8.0], [-20.0, 1.0]])
    clouds = [np.column_stack([rng.uniform(-1, 1, (200, 2)) + m, rng.uniform(-1, 0.5, 200)]) for m in middles]
    points = np.concatenate(clouds)
    boxes = cluster_boxes(np.concatenate([points, [[30.0, 30.0, 0.0]]]), GROUND)
    assert boxes.shape == (3, 7) and boxes.dtype == np.float32
    assert points_in_boxes(points, boxes, margin_m=1e-3).sum(axis=1).tolist() == [1] * 600
    assert np.allclose(boxes[:, 2] - boxes[:, 5] / 2, GROUND.heights(boxes[:, :2].astype(float)), atol=1e-5)
    hedge = np.column_stack([np.arange(1, 31, 0.1), np.full(300, 4.0), np.full(300, -0.5)])
    car = np.column_stack([np.arange(3, 7, 0.1), np.full(40, -2.0), np.full(40, -0.5)])
    boxes = cluster_boxes(np.concatenate([hedge, car]), GROUND)
    lengths = np.sort(boxes[:, 3:5].max(axis=1))
    assert np.allclose(lengths, [0.9, 3.9, 3.9, *[4.9] * 5], atol=1e-3)
    for points in (np.zeros((0, 3)), np.array([[10.0, 0, 0], [20, 0, 0]])):
        assert cluster_boxes(points, GROUND).shape == (0, 7)
