"""Compiled loops of `ball_query`, `three_nearest` and `nearest_in_cubes`."""

from typing import Any, TypeAlias

import numpy as np
from numba import types
from numpy.typing import NDArray

from asca_pillars.base.compiling import compiled, in_array, inner, out_array
from asca_pillars.ops.points.sampling import Columns, cells_of

_Floats = NDArray[np.float32]
_Integers = NDArray[np.int32]
_Cells = NDArray[np.int64]
_Three: TypeAlias = tuple[Any, Any, Any]

_CROWDED = 4  # times the samples stand in the columns around a query: its ball is probably full

_COLUMNS = in_array(types.int32), in_array(types.int32), types.int64, types.int64


def ball_query(
    xyz: _Floats,
    centers: _Floats,
    columns: Columns,
    offsets: _Integers,
    squared_radius: np.float32,
    samples: int,
    share: int,
) -> _Integers:
    """Compute `numpy_kernels._ball_query`, query by query: metres (N, 3), (Q, 3) -> indices (Q, samples)."""
    indices, sorted_xyz = np.empty((len(centers), samples), np.int32), np.empty((len(xyz), 3), np.float32)
    at = centers, cells_of(centers, columns)
    widths = np.zeros(2 * int(offsets.max()) + 1, np.int32)
    np.maximum.at(widths, offsets[:, 0] - offsets.min(), offsets[:, 1])
    ball = offsets, widths, squared_radius, share
    _ball_query(xyz, columns.order, columns.starts, *columns.shape, *at, *ball, sorted_xyz, indices)
    return indices


def three_nearest(xyz: _Floats, centers: _Floats, columns: Columns) -> tuple[_Integers, _Floats]:
    """Find the three nearest points in rings of columns around each query.

    Metres (N, 3), (Q, 3) -> indices (Q, 3) and squared distances (Q, 3) in m²; N and infinity where there is no point.
    """
    nearest = np.full((len(centers), 3), len(xyz), np.int32)
    squared = np.full((len(centers), 3), np.inf, np.float32)
    if len(xyz):
        at = centers, cells_of(centers, columns)
        _three_nearest(xyz, columns.order, columns.starts, *columns.shape, *at, columns.per_m, nearest, squared)
    return nearest, squared


def nearest_in_cubes(
    xyz: _Floats,
    centers: _Floats,
    columns: Columns,
    first: _Cells,
    last: _Cells,
    offsets: _Floats,
    reach_m: np.float32,
) -> _Integers:
    """Look through columns `first` to `last` (Q, 2) of each cube: (N, 3), (Q, 3) -> (Q, T, 3)."""
    nearest = np.empty((len(centers), len(offsets), 3), np.int32)
    at = centers, first, last
    room = np.empty(len(xyz), np.int32)
    _nearest_in_cubes(xyz, columns.order, columns.starts, columns.shape[1], *at, offsets, reach_m, room, nearest)
    return nearest


@compiled(
    in_array(types.float32, 2),
    *_COLUMNS,
    in_array(types.float32, 2),
    in_array(types.int64, 2),
    in_array(types.int32, 2),
    in_array(types.int32),
    types.float32,
    *(types.int64, out_array(types.float32, 2), out_array(types.int32, 2)),
)
def _ball_query(
    xyz: _Floats,
    order: _Integers,
    starts: _Integers,
    ny: int,
    nx: int,
    centers: _Floats,
    cells: _Cells,
    offsets: _Integers,
    widths: _Integers,
    squared_radius: float,
    share: int,
    sorted_xyz: _Floats,
    indices: _Integers,
) -> None:
    """Kernel of `ball_query`; `widths`: for each row of `offsets`, how many columns a ball reaches to either side."""
    for k in range(len(order)):
        for axis in range(3):
            sorted_xyz[k, axis] = xyz[order[k], axis]
    samples, reach = indices.shape[1], len(widths) // 2
    for query in range(len(centers)):
        x, y, z = centers[query, 0], centers[query, 1], centers[query, 2]
        row, column = cells[query, 0], cells[query, 1]
        # Columns beside each other are one run of points: a ball that is not full is found in a few runs.
        count, seen = 0, 0
        for other_row in range(max(row - reach, 0), min(row + reach, ny - 1) + 1):
            width = widths[other_row - row + reach]
            first, last = max(column - width, 0), min(column + width, nx - 1)
            if first > last:
                continue
            run, run_end = starts[other_row * nx + first], starts[other_row * nx + last + 1]
            seen += run_end - run
            if seen > _CROWDED * samples:
                break
            for k in range(run, run_end):
                dx, dy, dz = sorted_xyz[k, 0] - x, sorted_xyz[k, 1] - y, sorted_xyz[k, 2] - z
                indices[query, min(count, samples - 1)] = order[k]  # stays if it is inside
                count += dx * dx + dy * dy + dz * dz < squared_radius
        begin, end, more = 0, share, seen > _CROWDED * samples or count >= samples
        if more:
            count = 0
        while more and count < samples:  # first the first `share` points of each column, then those after them
            more = False
            for visit in range(len(offsets)):
                other_row, other_column = row + offsets[visit, 0], column + offsets[visit, 1]
                if other_row < 0 or other_row >= ny or other_column < 0 or other_column >= nx:
                    continue
                cell, inside = other_row * nx + other_column, 0
                for k in range(starts[cell], starts[cell + 1]):
                    dx, dy, dz = sorted_xyz[k, 0] - x, sorted_xyz[k, 1] - y, sorted_xyz[k, 2] - z
                    if dx * dx + dy * dy + dz * dz < squared_radius:
                        inside += 1
                        if inside > end:
                            more = True
                            break
                        if inside > begin:
                            indices[query, count] = order[k]
                            count += 1
                            if count == samples:
                                break
                if count == samples:
                    break
            begin, end = share, len(order)
        if count == samples:
            continue
        for place in range(1, count):
            moved, other = indices[query, place], place
            while other and indices[query, other - 1] > moved:
                indices[query, other] = indices[query, other - 1]
                other -= 1
            indices[query, other] = moved
        for rest in range(count, samples):
            indices[query, rest] = indices[query, 0] if count else len(xyz)


@inner
def _kept(i: int, distance: float, nearest: _Three, squared: _Three) -> tuple[_Three, _Three]:
    """Merge a point into the three nearest; of equally near ones the earlier comes first."""
    i0, i1, i2 = nearest
    d0, d1, d2 = squared
    if distance > d2 or (distance == d2 and i > i2):
        return nearest, squared
    if distance > d1 or (distance == d1 and i > i1):
        return (i0, i1, i), (d0, d1, distance)
    if distance > d0 or (distance == d0 and i > i0):
        return (i0, i, i1), (d0, distance, d1)
    return (i, i0, i1), (distance, d0, d1)


@compiled(
    *(in_array(types.float32, 2), *_COLUMNS, in_array(types.float32, 2), in_array(types.int64, 2), types.float32),
    *(out_array(types.int32, 2), out_array(types.float32, 2)),
)
def _three_nearest(
    xyz: _Floats,
    order: _Integers,
    starts: _Integers,
    ny: int,
    nx: int,
    centers: _Floats,
    cells: _Cells,
    per_m: float,
    nearest: _Integers,
    squared: _Floats,
) -> None:
    none, infinity = np.int64(len(xyz)), np.float32(np.inf)
    for query in range(len(centers)):
        x, y, z = centers[query, 0], centers[query, 1], centers[query, 2]
        row, column = min(max(cells[query, 0], 0), ny - 1), min(max(cells[query, 1], 0), nx - 1)
        indices, away = (none, none, none), (infinity, infinity, infinity)
        for ring in range(max(nx, ny)):
            # Points outside `ring - 1` rings are at least that many columns away, within rounding.
            clear = max(ring - np.float32(1.01), np.float32(0)) / per_m
            if away[2] < clear * clear:
                break
            for other_row in range(max(row - ring, 0), min(row + ring, ny - 1) + 1):
                step = 1 if abs(other_row - row) == ring else max(2 * ring, 1)
                for other_column in range(column - ring, column + ring + 1, step):
                    if other_column < 0 or other_column >= nx:
                        continue
                    cell = other_row * nx + other_column
                    for k in range(starts[cell], starts[cell + 1]):
                        i = np.int64(order[k])
                        dx, dy, dz = xyz[i, 0] - x, xyz[i, 1] - y, xyz[i, 2] - z
                        indices, away = _kept(i, dx * dx + dy * dy + dz * dz, indices, away)
        for rank in range(3):
            nearest[query, rank], squared[query, rank] = indices[rank], away[rank]


@compiled(
    in_array(types.float32, 2),
    in_array(types.int32),
    in_array(types.int32),
    types.int64,
    in_array(types.float32, 2),
    *(in_array(types.int64, 2), in_array(types.int64, 2), in_array(types.float32, 2), types.float32),
    *(out_array(types.int32), out_array(types.int32, 3)),
)
def _nearest_in_cubes(
    xyz: _Floats,
    order: _Integers,
    starts: _Integers,
    nx: int,
    centers: _Floats,
    first: _Cells,
    last: _Cells,
    offsets: _Floats,
    reach_m: float,
    room: _Integers,
    nearest: _Integers,
) -> None:
    none, infinity = np.int64(len(xyz)), np.float32(np.inf)
    for query in range(len(centers)):
        x, y, z = centers[query, 0], centers[query, 1], centers[query, 2]
        count = 0
        for row in range(first[query, 0], last[query, 0] + 1):
            for column in range(first[query, 1], last[query, 1] + 1):
                cell = row * nx + column
                for k in range(starts[cell], starts[cell + 1]):
                    i = order[k]
                    inside = abs(xyz[i, 0] - x) < reach_m and abs(xyz[i, 1] - y) < reach_m
                    if inside and abs(xyz[i, 2] - z) < reach_m:
                        room[count] = i
                        count += 1
        for cell in range(len(offsets)):
            at_x, at_y, at_z = x + offsets[cell, 0], y + offsets[cell, 1], z + offsets[cell, 2]
            indices, away = (none, none, none), (infinity, infinity, infinity)
            for k in range(count):
                i = np.int64(room[k])
                dx, dy, dz = xyz[i, 0] - at_x, xyz[i, 1] - at_y, xyz[i, 2] - at_z
                indices, away = _kept(i, dx * dx + dy * dy + dz * dz, indices, away)
            for rank in range(3):
                nearest[query, cell, rank] = indices[rank]
