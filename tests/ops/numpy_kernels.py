"""The loops that numba compiles, in NumPy: what the kernels of the package compute, bit for bit, and nothing faster."""

import itertools
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import product
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.overlap import bev_iou
from asca_pillars.ops.pillar.grid import PillarGrid
from asca_pillars.ops.pillar.prepare import FEATURES, evenly_spaced_mask
from asca_pillars.ops.points.sampling import Columns, cells_of
from asca_pillars.ops.pv_rcnn.voxels import VoxelGrid, Voxels
from asca_pillars.ops.sparse.rulebooks import AxisKernelMaps, CellMap, Shape

_NEAREST = 3
_PAIRS_AT_ONCE = _DISTANCES_AT_ONCE = 1 << 22
_NMS_BLOCK = 64


def by_numpy(function: Callable[..., Any], *arguments: Any) -> Any:
    """The function's result with the kernels of this file."""
    with ExitStack() as stack:
        for module in _USERS:
            stack.enter_context(patch(f"asca_pillars.{module}.load_kernels", lambda _: _KERNELS))
        return function(*arguments)


def both_forms(function: Callable[..., Any], *arguments: Any) -> Iterator[Any]:
    """The result with the compiled kernels, and with those of this file."""
    yield function(*arguments)
    yield by_numpy(function, *arguments)


def _sort_points(
    points: NDArray[np.float32], grid: PillarGrid
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Indices of the points inside, sorted by cell; the occupied cells, ascending; how many points each holds."""
    cell_of_point = grid.cells(points)
    order = np.flatnonzero(cell_of_point >= 0)
    order = order[_stable_argsort(cell_of_point[order])]
    starts = np.flatnonzero(np.diff(cell_of_point[order], prepend=-1))
    return order, cell_of_point[order[starts]], np.diff(starts, append=len(order))


def _stable_argsort(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """np.argsort(keys, kind="stable") for keys >= 0, several times faster.

    NumPy sorts 16-bit integers by radix, so one pass per 16-bit digit does it. Stable, hence the same on
    every machine, which NumPy's default sort is not.
    """
    order = np.arange(len(keys))
    for shift in range(0, int(keys.max(initial=0)).bit_length(), 16):
        digit = (keys[order] >> shift).astype(np.uint16)
        order = order[np.argsort(digit, kind="stable")]
    return order


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
    pillar_of_point = np.repeat(np.arange(len(cells)), counts)
    stays = kept[pillar_of_point]
    starts = np.cumsum(counts) - counts
    stays &= evenly_spaced_mask(np.arange(len(order)) - starts[pillar_of_point], counts[pillar_of_point], max_points)

    point_counts = np.minimum(counts[kept], max_points)
    features = _features(points.take(order[stays], axis=0), point_counts, grid.cell_centers_m(cells[kept]))
    return features, np.repeat(np.arange(len(point_counts)), point_counts), point_counts


def _features(
    points: NDArray[np.float32], counts: NDArray[np.int64], centers_m: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Points sorted by pillar (M, 4), points per pillar (P,) and pillar centers (P, 2) -> (M, 9)."""
    features = np.empty((len(points), len(FEATURES)), np.float32)
    pillar_index = np.repeat(np.arange(len(counts)), counts)
    # One channel at a time: NumPy is slow along an axis as short as the channels'.
    for channel in range(4):
        features[:, channel] = points[:, channel]
    for axis in range(3):
        # bincount sums in float64 and in order, so the mean does not depend on the machine.
        means = np.bincount(pillar_index, weights=points[:, axis], minlength=len(counts)) / counts
        features[:, 4 + axis] = points[:, axis] - np.repeat(means.astype(np.float32), counts)
    for axis in range(2):
        features[:, 7 + axis] = points[:, axis] - np.repeat(centers_m[:, axis], counts)
    return features


def _nms(boxes: NDArray[np.float64], iou_threshold: float, limit: int) -> NDArray[np.int64]:
    """`rotated_nms` of boxes that come best first."""
    waiting = np.arange(len(boxes))
    kept = [waiting[:0]]
    while len(waiting) and sum(map(len, kept)) < limit:
        block, waiting = waiting[:_NMS_BLOCK], waiting[_NMS_BLOCK:]
        clashes = bev_iou(boxes[block], boxes[block]) > iou_threshold
        alive = np.ones(len(block), bool)
        for index, row in enumerate(clashes):
            if alive[index]:
                alive[index + 1 :] &= ~row[index + 1 :]
        kept.append(block[alive])
        clashes = bev_iou(boxes[block[alive]], boxes[waiting]) > iou_threshold
        waiting = waiting[~clashes.any(axis=0)]
    return np.concatenate(kept)[:limit]


def _sort(
    xyz: NDArray[np.float32], x_low: np.float32, y_low: np.float32, per_m: np.float32, ny: int, nx: int
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    column = ((xyz[:, 0] - x_low) * per_m).astype(np.int64)
    column += ((xyz[:, 1] - y_low) * per_m).astype(np.int64) * nx
    starts = np.zeros(ny * nx + 1, np.int32)
    np.cumsum(np.bincount(column, minlength=ny * nx), out=starts[1:])
    return np.argsort(column, kind="stable").astype(np.int32), starts


def _near_circles(
    points: NDArray[np.float32], centers: NDArray[np.float32], squared: NDArray[np.float32]
) -> NDArray[np.float32]:
    x, y = (np.ascontiguousarray(points[:, axis]) for axis in range(2))
    near = np.zeros(len(points), bool)
    for (center_x, center_y), limit in zip(centers, squared, strict=True):
        dx, dy = x - center_x, y - center_y
        near |= dx * dx + dy * dy < limit
    return points[near]


def _farthest_points(xyz: NDArray[np.float32], count: int) -> NDArray[np.int32]:
    chosen = [0]
    x, y, z = np.ascontiguousarray(xyz[:, :3].T)
    nearest = np.full(len(xyz), np.inf, np.float32)
    while len(chosen) < count:
        dx, dy, dz = x - x[chosen[-1]], y - y[chosen[-1]], z - z[chosen[-1]]
        np.minimum(nearest, dx * dx + dy * dy + dz * dz, out=nearest)
        farthest = int(nearest.argmax())
        if nearest[farthest] == 0:
            break
        chosen.append(farthest)
    return np.array(chosen, np.int32)


def _read_map(rows: NDArray[Any], cells: NDArray[np.int32], weights: NDArray[np.float32]) -> NDArray[np.float32]:
    read = np.zeros((len(cells), rows.shape[1]), np.float32)
    for corner in range(cells.shape[1]):
        read += rows[cells[:, corner]] * weights[:, corner, None]
    return read


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


def _three_nearest(
    xyz: NDArray[np.float32], centers: NDArray[np.float32]
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    nearest = np.full((len(centers), _NEAREST), len(xyz), np.int32)
    squared = np.full((len(centers), _NEAREST), np.inf, np.float32)
    there = min(_NEAREST, len(xyz))
    step = max(1, _PAIRS_AT_ONCE // max(len(xyz), 1))
    for start in range(0, len(centers) if there else 0, step):
        part = slice(start, start + step)
        dx, dy, dz = (xyz[None, :, axis] - centers[part, None, axis] for axis in range(3))
        distance = dx * dx + dy * dy + dz * dz
        for rank in range(there):
            best = distance.argmin(axis=1)
            nearest[part, rank] = best
            squared[part, rank] = np.take_along_axis(distance, best[:, None], axis=1)[:, 0]
            np.put_along_axis(distance, best[:, None], np.float32(np.inf), axis=1)
    return nearest, squared


def _nearest_in_cubes(
    xyz: NDArray[np.float32], centers: NDArray[np.float32], offsets: NDArray[np.float32], reach_m: np.float32
) -> NDArray[np.int32]:
    nearest = np.full((len(centers), len(offsets), _NEAREST), len(xyz), np.int32)
    step = max(1, _DISTANCES_AT_ONCE // (max(len(xyz), 1) * len(offsets)))
    for start in range(0, len(centers) if len(xyz) else 0, step):
        part = slice(start, start + step)
        away = np.abs(xyz[None] - centers[part, None])  # (q, N, 3)
        outside = (away >= reach_m).any(axis=2)
        places = centers[part, None] + offsets  # (q, T, 3)
        dx, dy, dz = (xyz[None, None, :, axis] - places[:, :, None, axis] for axis in range(3))
        distance = dx * dx + dy * dy + dz * dz  # (q, T, N)
        distance[np.broadcast_to(outside[:, None], distance.shape)] = np.inf
        for rank in range(_NEAREST):
            best = distance.argmin(axis=2)[..., None]
            found = np.take_along_axis(distance, best, axis=2) < np.inf
            nearest[part, :, rank] = np.where(found, best, len(xyz))[..., 0]
            np.put_along_axis(distance, best, np.float32(np.inf), axis=2)
    return nearest


_KERNELS = SimpleNamespace(
    sort_points=_sort_points,
    fill_pillars=_fill_pillars,
    nms=_nms,
    sort=_sort,
    farthest_points=lambda xyz, count, _: _farthest_points(xyz, count),
    near_circles=_near_circles,
    read_map=_read_map,
    ball_query=_ball_query,
    three_nearest=lambda xyz, centers, _: _three_nearest(xyz, centers),
    nearest_in_cubes=lambda xyz, centers, _columns, _first, _last, *cube: _nearest_in_cubes(
        xyz[:, :3], centers[:, :3], *cube
    ),
)
_USERS = "detection.decode", "ops.pillar.prepare", "ops.points.sampling", "ops.points.neighbors"


class NumpyCellMap(CellMap):
    """A `CellMap` without columns and bits."""

    def activate(self, cells: NDArray[np.int64]) -> None:
        self.cells = cells

    def activate_joined(self, sources: Any) -> None:
        joined = [
            cells[joins]
            for source, kernel_maps in sources
            for cells, joins in _taps(source.cells, kernel_maps, self.shape)
        ]
        self.cells = np.unique(np.concatenate(joined))

    def rulebook(self, source: CellMap, kernel_maps: AxisKernelMaps) -> NDArray[np.int32]:
        taps = [
            np.where(joins, _rows(source.cells, cells), len(source))
            for cells, joins in _taps(self.cells, kernel_maps, source.shape)
        ]
        return np.stack(taps, axis=1).astype(np.int32)

    def places(self, parents: CellMap, halvings: int) -> NDArray[np.int32]:
        stride = 1 << halvings
        y, x = np.divmod(self.cells, self.shape[2])
        parent = _rows(parents.cells, y // stride * parents.shape[2] + x // stride)
        places = parent * stride**2 + y % stride * stride + x % stride
        return np.where(parent < len(parents), places, len(parents) * stride**2).astype(np.int32)


def _taps(
    cells: NDArray[np.int64], kernel_maps: AxisKernelMaps, other: Shape
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.bool_]]]:
    """Tap by tap: the cells of `other` that it joins with `cells`, and whether it joins them with any; (N,) both."""
    yx, z = np.divmod(cells, len(kernel_maps.z))
    y, x = np.divmod(yx, len(kernel_maps.x))
    for z_tap, y_tap, x_tap in product(kernel_maps.z.T, kernel_maps.y.T, kernel_maps.x.T):
        other_z, other_y, other_x = z_tap[z], y_tap[y], x_tap[x]
        joins = (other_z >= 0) & (other_y >= 0) & (other_x >= 0)
        yield (other_y * other[2] + other_x) * other[0] + other_z, joins


def _rows(sorted_cells: NDArray[np.int64], expected: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where each wanted cell stands among the sorted ones, len(sorted_cells) if it does not."""
    if not len(sorted_cells):
        return np.zeros(len(expected), np.int64)
    rows = np.searchsorted(sorted_cells, expected)
    found = sorted_cells[np.minimum(rows, len(sorted_cells) - 1)] == expected
    return np.where(found, rows, len(sorted_cells))


def voxels(points: NDArray[np.float32], grid: VoxelGrid) -> Voxels:
    """As `voxelize`."""
    cells_of_points = voxel_cells(points, grid)
    cells = np.unique(cells_of_points[cells_of_points >= 0])
    features = _means(points, cells_of_points, cells, grid.max_points)
    return Voxels(features, cells, int((cells_of_points < 0).sum()))


def voxel_cells(points: NDArray[np.float32], grid: VoxelGrid) -> NDArray[np.int64]:
    """As `VoxelGrid.cells`."""
    lows_m, highs_m = (np.array(ends, np.float32) for ends in zip(*grid.ranges_m, strict=True))
    z, y, x = grid.shape
    last = np.array([x, y, z - grid.empty_layers]) - 1
    return _cells_of_points(points[:, :3], lows_m, highs_m, np.array(grid.size_m, np.float32), last, grid.shape)


def _cells_of_points(
    xyz: NDArray[np.float32],
    lows_m: NDArray[np.float32],
    highs_m: NDArray[np.float32],
    sizes_m: NDArray[np.float32],
    last: NDArray[np.int64],
    shape: Shape,
) -> NDArray[np.int64]:
    """(M,) flat index of each point's voxel, -1 outside; a border belongs to the voxel above it."""
    inside = ((xyz >= lows_m) & (xyz < highs_m)).all(axis=1)
    # float32 throughout, and the quotient may round up to the range's end: its last voxel has the point.
    chosen = np.floor((xyz[inside] - lows_m) / sizes_m).astype(np.int64)
    x, y, z = np.minimum(chosen, last).T
    cells = np.full(len(xyz), -1, np.int64)
    cells[inside] = (y * shape[2] + x) * shape[0] + z
    return cells


def _means(
    points: NDArray[np.float32], cell_of_point: NDArray[np.int64], cells: NDArray[np.int64], max_points: int
) -> NDArray[np.float32]:
    order = np.argsort(cell_of_point, kind="stable")
    order = order[cell_of_point[order] >= 0]
    voxel = np.searchsorted(cells, cell_of_point[order])
    first = np.arange(len(order)) - np.searchsorted(voxel, voxel) < max_points
    order, voxel = order[first], voxel[first]
    counts = np.bincount(voxel, minlength=len(cells))
    sums = [np.bincount(voxel, weights=points[order, c], minlength=len(cells)) for c in range(points.shape[1])]
    return (np.stack(sums, axis=-1) / counts[:, None]).astype(np.float32)
