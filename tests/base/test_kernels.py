"""The compiled forms against the NumPy forms, bit for bit, and the results that no form may change."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from asca_pillars.base.kernels import load_kernels
from asca_pillars.detection import decode
from asca_pillars.detection.decode import rotated_nms
from asca_pillars.geometry import overlap
from asca_pillars.ops.pillar.grid import PillarGrid
from asca_pillars.ops.pillar.prepare import PillarLimits, Pillars, pillarize
from tests.ops.numpy_kernels import by_numpy

# Rectangular, off center, with a positive minimum, and columns of one to three depths.
GRIDS = tuple(
    PillarGrid(x_range_m=(2.0, far_m), y_range_m=(-1.28, 2.56), z_range_m=(-2.5, 1.5), zones=zones)
    for zones, far_m in ((1, 9.68), (2, 7.12), (3, 9.68))
)
LIMITS = (PillarLimits(2**31 - 1, 2**31 - 1), PillarLimits(20, 3), PillarLimits(10**9, 2), PillarLimits(15, 10**9))


def assert_same_bits(first: Pillars, second: Pillars) -> None:
    for field in dataclasses.fields(Pillars)[:-1]:
        one, other = getattr(first, field.name), getattr(second, field.name)
        assert (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes()), field.name
    assert first.stats == second.stats


def border_values(grid: PillarGrid) -> list[np.ndarray]:
    """Along x, y and z: every border there is, and the float32 numbers next to it."""
    edges = (axis.astype(np.float32) for axis in (grid.x_edges_m, grid.y_edges_m, np.array(grid.z_range_m)))
    return [np.concatenate([e, *(np.nextafter(e, np.float32(end)) for end in (-100, 100))]) for e in edges]


def cloud(seed: int, count: int, spread_m: float, grid: PillarGrid, odd: float) -> np.ndarray:
    """(count, 4) points around a place in the grid, the share `odd` of their values on borders or not finite."""
    rng = np.random.default_rng(seed)
    points = rng.normal((5.0, 0.5, -0.5, 0.5), (spread_m, spread_m, 1.0, 0.2), (count, 4)).astype(np.float32)
    for axis, values in enumerate(border_values(grid)):
        chosen = rng.random(count) < odd
        points[chosen, axis] = rng.choice([*values, np.nan, np.inf, -np.inf, -0.0], chosen.sum())
    return points


@settings(max_examples=60)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([0, 1, 2, 40, 400]),
    st.sampled_from([0.05, 0.5, 5.0]),
    st.sampled_from([0.0, 0.3]),
    st.sampled_from(GRIDS),
    st.sampled_from(LIMITS),
)
@example(0, 400, 0.5, 0.0, GRIDS[2], PillarLimits(1, 1))
def test_pillars_are_the_same(
    seed: int, count: int, spread_m: float, odd: float, grid: PillarGrid, limits: PillarLimits
) -> None:
    points = cloud(seed, count, spread_m, grid, odd)
    assert_same_bits(pillarize(points, grid, limits), by_numpy(pillarize, points, grid, limits))


@pytest.mark.parametrize("grid", GRIDS, ids=lambda grid: f"{grid.nx}x{grid.ny}")
def test_points_on_borders_fall_into_the_same_pillars(grid: PillarGrid) -> None:
    values = border_values(grid)
    lines = []
    for axis, along in enumerate(values):
        line = np.zeros((len(along), 4), np.float32)
        line[:, :2] = values[0][3], values[1][3]
        line[:, axis] = along
        lines.append(line)
    points = np.concatenate(lines)
    pillars = pillarize(points, grid, LIMITS[0])
    assert pillars.stats.pillars >= grid.nx + grid.ny - 1 and pillars.stats.points_outside > 0
    assert_same_bits(pillars, by_numpy(pillarize, points, grid, LIMITS[0]))


def test_memory_that_numba_does_not_know_is_copied() -> None:
    points = cloud(3, 400, 0.5, GRIDS[2], 0.0)
    expected = pillarize(points, GRIDS[2], LIMITS[1])
    frozen = np.frombuffer(points.tobytes(), np.float32).reshape(-1, 4)  # read-only
    skewed = np.frombuffer(b"?" + points.tobytes(), np.float32, offset=1).reshape(-1, 4)  # not aligned
    others: list[NDArray[Any]] = [frozen, skewed, np.asfortranarray(points), points.astype(">f4"), points.astype(float)]
    for other in others:
        assert_same_bits(pillarize(other, GRIDS[2], LIMITS[1]), expected)


def boxes_around(seed: int, count: int, spread_m: float) -> tuple[np.ndarray, np.ndarray]:
    """(count, 7) boxes in all directions, some of them equal, aligned or without area, and scores with ties."""
    rng = np.random.default_rng(seed)
    low, high = [20, -5, -1, 0.3, 0.3, 1, -7], [20 + spread_m, -5 + spread_m, 0, 5, 2.5, 2, 7]
    boxes = rng.uniform(low, high, (count, 7)).astype(np.float32)
    boxes[rng.random(count) < 0.1, 6] = 0
    boxes[rng.random(count) < 0.03, 3] = 0
    again = np.flatnonzero(rng.random(count) < 0.1)
    boxes[again] = boxes[rng.integers(0, max(count, 1), len(again))]
    return boxes, np.round(rng.normal(size=count), 2)


@settings(max_examples=60)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([0, 1, 2, 30, 200]),
    st.sampled_from([1.0, 8.0, 40.0]),
    st.sampled_from([0.01, 0.3, 0.7, 1.0]),
    st.sampled_from([None, 1, 7, 1000]),
)
def test_suppression_is_the_same(seed: int, count: int, spread_m: float, threshold: float, limit: int | None) -> None:
    boxes, scores = boxes_around(seed, count, spread_m)
    kept = rotated_nms(boxes, scores, threshold, limit)
    assert kept.dtype == np.int64
    assert kept.tolist() == by_numpy(rotated_nms, boxes, scores, threshold, limit).tolist()
    assert kept.tolist() == rotated_nms(boxes, scores, threshold)[:limit].tolist()


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.5, 4.0]))
def test_the_shared_area_is_the_same(seed: int, spread_m: float) -> None:
    # Through the threshold, which is all that suppression lets see: just below the overlap the second box falls.
    (boxes, _), scores = boxes_around(seed, 2, spread_m), np.array([2.0, 1.0])
    iou = overlap.bev_iou(boxes[:1], boxes[1:])[0, 0]
    if iou > 1e-9:
        assert rotated_nms(boxes, scores, iou * (1 - 1e-9)).tolist() == [0]
        assert rotated_nms(boxes, scores, iou * (1 + 1e-9)).tolist() == [0, 1]


def test_boxes_that_are_not_finite_clash_with_nothing_and_nothing_is_compiled_at_use() -> None:
    boxes, scores = np.ones((4, 7), np.float32), np.array([4.0, 3.0, 2.0, 1.0])
    boxes[1, 0], boxes[2, 3] = np.nan, np.nan
    assert rotated_nms(boxes, scores, 0.5).tolist() == [0, 1, 2] == by_numpy(rotated_nms, boxes, scores, 0.5).tolist()
    scratch = np.empty((1, 3)), np.empty((1, 5)), np.empty(1, np.int64)
    with pytest.raises(TypeError, match="No matching definition"):
        load_kernels(decode.KERNELS)._nms(np.zeros((1, 7), np.float32), 0.5, 1, *scratch)
