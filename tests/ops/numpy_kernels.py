"""Loops of which every bit and the order matter, in NumPy: pillars, suppression, and what a full ball holds."""

import itertools
from collections.abc import Callable
from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.overlap import bev_iou
from asca_pillars.ops.pillar.grid import PillarGrid
from asca_pillars.ops.pillar.prepare import FEATURES, evenly_spaced_mask
from asca_pillars.ops.points.sampling import Columns, cells_of


def by_numpy(function: Callable[..., Any], *arguments: Any) -> Any:
    """The function's result with the kernels of this file."""
    with ExitStack() as stack:
        for module in _USERS:
            stack.enter_context(patch(f"asca_pillars.{module}.load_kernels", lambda _: _KERNELS))
        return function(*arguments)


def _sort_points(
    points: NDArray[np.float32], grid: PillarGrid
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Indices of the points inside, sorted by cell; the occupied cells, ascending; how many points each holds."""
    cell_of_point = grid.cells(points)
    order = np.flatnonzero(cell_of_point >= 0)
    order = order[np.argsort(cell_of_point[order], kind="stable")]
    starts = np.flatnonzero(np.diff(cell_of_point[order], prepend=-1))
    return order, cell_of_point[order[starts]], np.diff(starts, append=len(order))


def _fill_pillars(
    points: NDArray[np.float32],
    order: NDArray[np.int64],
    cells: NDArray[np.int64],
    counts: NDArray[np.int64],
    kept: NDArray[np.bool_],
    max_points: int,
    grid: PillarGrid,
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.int64]]:
    """Features (M, 9), pillar index (M,) and points per pillar (P,) of what is kept.

    Args:
        order: the points inside, sorted by pillar; `cells` (Q,) and `counts` (Q,) describe the pillars.
        kept: (Q,) which pillars stay.
    """
    ranks = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    stays = np.repeat(kept, counts) & evenly_spaced_mask(ranks, np.repeat(counts, counts), max_points)
    points, counts = points.take(order[stays], axis=0), np.minimum(counts[kept], max_points)
    index = np.repeat(np.arange(len(counts)), counts)
    features = np.empty((len(points), len(FEATURES)), np.float32)
    features[:, :4] = points
    for axis in range(3):
        # bincount sums in float64 and in order, so the mean does not depend on the machine.
        means = np.bincount(index, weights=points[:, axis], minlength=len(counts)) / counts
        features[:, 4 + axis] = points[:, axis] - means.astype(np.float32)[index]
    features[:, 7:] = points[:, :2] - grid.cell_centers_m(cells[kept])[index]
    return features, index, counts


def _nms(boxes: NDArray[np.float64], iou_threshold: float, limit: int) -> NDArray[np.int64]:
    """`rotated_nms` of boxes that come best first."""
    waiting, kept = np.arange(len(boxes)), np.empty(0, np.int64)
    while len(waiting) and len(kept) < limit:
        kept, waiting = np.append(kept, waiting[0]), waiting[1:]
        waiting = waiting[bev_iou(boxes[kept[-1:]], boxes[waiting])[0] <= iou_threshold]
    return kept


def _sort(
    xyz: NDArray[np.float32], x_low: np.float32, y_low: np.float32, per_m: np.float32, ny: int, nx: int
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    column = ((xyz[:, 0] - x_low) * per_m).astype(np.int64)
    column += ((xyz[:, 1] - y_low) * per_m).astype(np.int64) * nx
    starts = np.zeros(ny * nx + 1, np.int32)
    np.cumsum(np.bincount(column, minlength=ny * nx), out=starts[1:])
    return np.argsort(column, kind="stable").astype(np.int32), starts


def _ball_query(
    xyz: NDArray[np.float32],
    centers: NDArray[np.float32],
    columns: Columns,
    offsets: NDArray[np.int32],
    squared_radius: np.float32,
    samples: int,
    share: int,
) -> NDArray[np.int32]:
    ny, nx = columns.shape
    row, column = cells_of(centers, columns).T
    found = np.full((len(centers), samples), len(xyz), np.int32)
    counts = np.zeros(len(centers), np.int64)
    for first, (row_offset, column_offset) in itertools.product((True, False), offsets.tolist()):
        rows, cols = row + row_offset, column + column_offset
        asking = np.flatnonzero((counts < samples) & (rows >= 0) & (rows < ny) & (cols >= 0) & (cols < nx))
        cell = rows[asking] * nx + cols[asking]
        start, size = columns.starts[cell], np.diff(columns.starts)[cell]
        query = np.repeat(asking, size)
        place = np.arange(len(query)) - np.repeat(np.cumsum(size) - size, size) + np.repeat(start, size)
        point = columns.order[place]
        dx, dy, dz = (xyz[point, axis] - centers[query, axis] for axis in range(3))
        inside = dx * dx + dy * dy + dz * dz < squared_radius
        query, point = query[inside], point[inside]
        now = (np.arange(len(query)) - np.searchsorted(query, query) < share) == first
        query, point = query[now], point[now]
        rank = counts[query] + np.arange(len(query)) - np.searchsorted(query, query)
        np.add.at(counts, query, 1)
        taken = rank < samples
        found[query[taken], rank[taken]] = point[taken]
    found[counts < samples] = np.sort(found[counts < samples], axis=1)
    return np.where(np.arange(samples) < counts[:, None], found, found[:, :1])


_KERNELS = SimpleNamespace(
    sort_points=_sort_points, fill_pillars=_fill_pillars, nms=_nms, sort=_sort, ball_query=_ball_query
)
_USERS = "detection.decode", "ops.pillar.prepare", "ops.points.sampling", "ops.points.neighbors"
