"""Farthest-point sampling against its definition, points near boxes against shapely, maps against grid_sample."""

import numpy as np
import pytest
import shapely
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from asca_pillars.ops.points.sampling import bilinear_cells, farthest_points, points_near_boxes, read_map
from tests.ops.points.clouds import CLOUDS, cloud, squared_distances

STRAY = cloud(2, 100, 5.0, coarse=False)
STRAY[50, :2] = 3e7, -2e7


def plain(points: np.ndarray, count: int) -> list[int]:
    """PointNet++'s sampling, one loop inside the other."""
    chosen = [0][: min(len(points), count)]
    while chosen and len(chosen) < count:
        away = squared_distances(points[chosen], points).min(axis=1)
        if away.max() == 0:
            break
        chosen.append(int(away.argmax()))
    return chosen


@settings(max_examples=40)
@given(CLOUDS, st.integers(0, 40))
@example(STRAY, 20)
@example(np.repeat(cloud(0, 30, 5.0, coarse=False), 3, axis=0), 1000)  # every position once
def test_is_plain_sampling(points: np.ndarray, count: int) -> None:
    found = farthest_points(points, count)
    assert found.dtype == np.int32 and found.tolist() == plain(points, count)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_refuses_what_has_no_place(bad: float) -> None:
    points = cloud(0, 5, 1.0, coarse=False)
    points[3, 1] = bad
    with pytest.raises(ValueError, match="finite"):
        farthest_points(points, 2)
    with pytest.raises(ValueError, match="shape"):
        farthest_points(points[:, :2], 2)


def near_circles(points: np.ndarray, boxes: np.ndarray, margin_m: float) -> np.ndarray:
    """In float32, each circle against each point."""
    reach = (np.hypot(boxes[:, 3], boxes[:, 4]) / 2 + margin_m).astype(np.float32)
    dx, dy = (points[:, None, axis] - boxes[None, :, axis].astype(np.float32) for axis in range(2))
    return points[(dx * dx + dy * dy < reach * reach).any(axis=1)]


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(0, 6), st.floats(0, 5), st.sampled_from([0.0, 60.0, 3e4, 1e7]))
def test_points_near_boxes(seed: int, count: int, margin_m: float, offset_m: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-20, 20, (200, 4)).astype(np.float32)
    boxes = rng.uniform([-20, -20, 0, 0.5, 0.5, 1, -3], [20, 20, 1, 5, 2, 2, 3], (count, 7)).astype(np.float32)
    points[:, :2] += offset_m
    boxes[:, :2] += offset_m
    points[0, :2] = -3e7  # a stray one
    near = points_near_boxes(points, boxes, margin_m)
    np.testing.assert_array_equal(near, near_circles(points, boxes, margin_m))
    if offset_m > 60:  # float32 rounds too much for shapely's answer
        return
    reach = np.hypot(boxes[:, 3], boxes[:, 4]) / 2 + margin_m
    disks = [(shapely.Point(box[:2]), r) for box, r in zip(boxes, reach, strict=True)]
    found = {row.tobytes() for row in near}
    for point in points:
        away = [center.distance(shapely.Point(point[:2])) - r for center, r in disks]
        if not any(abs(gap) < 1e-4 for gap in away):
            assert (point.tobytes() in found) == any(gap < 0 for gap in away)


def test_points_near_circles_of_any_size() -> None:
    """Cells that a circle covers, reaches or leaves out, and points on their borders."""
    points = (np.random.default_rng(0).integers(-400, 400, (20000, 4)) / 8).astype(np.float32)
    sizes = [(0.01, 0.01), (0.75, 1.0), (3.0, 4.0), (48.0, 64.0)]  # of all but the first the radius is whole eighths
    boxes = np.array([[x, 10 - x, 0, *size, 1, 0] for x, size in zip((-30, 20, 3, 5), sizes, strict=True)])
    points[:4, :2] = boxes[:, :2] + np.stack([np.hypot(*np.array(sizes).T) / 2 + 0.25, np.zeros(4)], axis=1)
    for some in (boxes[:2], boxes[1:3], boxes):
        found = points_near_boxes(points, some, 0.25)
        assert 0 < len(found) < len(points)
        np.testing.assert_array_equal(found, near_circles(points, some, 0.25))


@given(st.integers(0, 2**32 - 1))
def test_bilinear_cells_are_those_of_grid_sample(seed: int) -> None:
    rng = np.random.default_rng(seed)
    height, width = rng.integers(2, 9, 2)
    image = rng.normal(size=(height, width)).astype(np.float32)
    x_m, y_m = 3 + 0.4 * np.arange(width), -2 + 0.3 * np.arange(height)
    points = rng.uniform([2, -3], [3 + 0.4 * width, -2 + 0.4 * height], (30, 2))
    cells, weights = bilinear_cells(points, x_m, y_m)
    assert (weights >= 0).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=1e-6)
    place = np.stack([(points[:, 0] - 3) / 0.4 / (width - 1), (points[:, 1] + 2) / 0.3 / (height - 1)], axis=1) * 2 - 1
    expected = torch.nn.functional.grid_sample(
        torch.from_numpy(image)[None, None].double(),
        torch.from_numpy(place)[None, None],
        align_corners=True,
        padding_mode="border",
    )
    np.testing.assert_allclose((image.ravel()[cells] * weights).sum(axis=1), expected[0, 0, 0], atol=1e-5)


def test_cells_need_not_be_evenly_spaced() -> None:
    cells, weights = bilinear_cells(np.array([[2.5, 0.0]]), np.array([0.0, 1.0, 4.0]), np.array([0.0, 1.0]))
    assert cells.tolist() == [[1, 2, 4, 5]]
    assert weights[0] == pytest.approx([0.5, 0.5, 0, 0])


@given(st.integers(0, 2**32 - 1), st.integers(0, 20), st.sampled_from([np.float32, np.uint8]))
def test_a_map_is_read_at_its_cells(seed: int, count: int, dtype: type[np.generic]) -> None:
    rng = np.random.default_rng(seed)
    rows = rng.uniform(0, 255, (30, 9)).astype(dtype)
    cells = rng.integers(0, 30, (count, 4)).astype(np.int32)
    weights = rng.random((count, 4), np.float32)
    expected = (rows[cells].astype(np.float32) * weights[..., None]).sum(axis=1)
    np.testing.assert_allclose(read_map(rows, cells, weights), expected, rtol=1e-5, strict=True)
