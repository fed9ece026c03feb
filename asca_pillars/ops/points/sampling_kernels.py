"""Compiled loops of `sampling`: columns, farthest points, circles and bilinear interpolation."""

import math
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from asca_pillars.base.compiling import compiled, in_array, inner, out_array
from asca_pillars.ops.points.sampling import Columns

_Floats = NDArray[np.float32]
_Integers = NDArray[np.int32]
_Bools = NDArray[np.bool_]

_MAX_CELLS = 256  # along each axis, of those that tell which points are near circles
_NO_CIRCLE, _COVERED = -1, -2

_COLUMNS = (
    in_array(types.int32),
    in_array(types.int32),
    types.float32,
    types.float32,
    types.float32,
    types.int64,
    types.int64,
)


def sort(
    xyz: _Floats, x_low: np.float32, y_low: np.float32, per_m: np.float32, ny: int, nx: int
) -> tuple[_Integers, _Integers]:
    """Compute `numpy_kernels._sort` by counting: (N, 3) -> `Columns.order` (N,), `Columns.starts` (ny * nx + 1,)."""
    order, starts = np.empty(len(xyz), np.int32), np.zeros(ny * nx + 1, np.int32)
    _sort(xyz, x_low, y_low, per_m, nx, np.empty(len(xyz), np.int32), order, starts)
    return order, starts


def farthest_points(xyz: _Floats, count: int, columns: Columns) -> _Integers:
    """Sample the farthest points by columns: (N, 3) in metres -> indices (S,), S at most `count`."""
    cells = len(columns.starts) - 1
    chosen = np.empty(min(count, len(xyz)), np.int32)
    sampled = _farthest_points(
        *(xyz, *_flat(columns)),
        *(np.empty((4, len(xyz)), np.float32), np.empty((cells, 6), np.float32), np.empty(cells, np.float32)),
        *(np.empty(cells, np.int32), np.empty(columns.shape[0], np.int32), chosen),
    )
    return chosen[:sampled]


def near_circles(points: _Floats, centers: _Floats, squared: _Floats) -> _Floats:
    """Keep the points in any of the circles: rows (N, 4), circles (R, 2) in metres, (R,) in m² -> rows (M, 4)."""
    if not len(centers):
        return points[:0]
    reach = np.sqrt(squared)[:, None]
    # By which float32 may misplace a point.
    slack = np.float32(1e-3 + 1e-5 * (float(np.abs(centers).max()) + float(reach.max())))
    low, high = (centers - reach - slack).min(axis=0), (centers + reach + slack).max(axis=0)
    cell_m = np.float32(max(1.0, float((high - low).max()) / _MAX_CELLS))
    nx, ny = (int(cells) + 1 for cells in (high - low) / cell_m)
    room = int((np.square(2 * (reach + slack) / cell_m + 4)).sum())  # a circle's cells in either direction, or more
    heads, links = np.full((ny, nx), _NO_CIRCLE, np.int32), np.empty((room, 2), np.int32)
    near = np.empty(points.shape, np.float32)
    circles = np.ascontiguousarray(centers), squared
    return near[: _near_circles(points, *circles, low[0], low[1], cell_m, slack, heads, links, near)]


def read_map(rows: NDArray[Any], cells: _Integers, weights: _Floats) -> _Floats:
    """Interpolate a map: rows (H * W, C) float32 or uint8, cells and weights (K, 4) -> (K, C)."""
    read = np.zeros((len(cells), rows.shape[1]), np.float32)
    (_read_steps if rows.dtype == np.uint8 else _read_floats)(rows, cells, weights, read)
    return read


def _flat(columns: Columns) -> tuple[Any, ...]:
    return columns.order, columns.starts, *columns.origin_m, columns.per_m, *columns.shape


@inner
def _column(value: Any, low: Any, per_m: Any) -> int:
    """Compute `columns.cells_of` of one value."""
    return math.floor(min(max((value - low) * per_m, np.float32(-1e6)), np.float32(1e6)))


@compiled(
    *(in_array(types.float32, 2), types.float32, types.float32, types.float32, types.int64),
    *(out_array(types.int32), out_array(types.int32), out_array(types.int32)),
)
def _sort(
    xyz: _Floats,
    x_low: float,
    y_low: float,
    per_m: float,
    nx: int,
    cell_of_point: _Integers,
    order: _Integers,
    starts: _Integers,
) -> None:
    for i in range(len(xyz)):
        cell = int((xyz[i, 1] - y_low) * per_m) * nx + int((xyz[i, 0] - x_low) * per_m)
        cell_of_point[i] = cell
        starts[cell + 1] += 1
    total = 0
    for cell in range(1, len(starts)):  # starts[c + 1]: first the number in c, then where c's next point goes
        number = starts[cell]
        starts[cell] = total
        total += number
    for i in range(len(xyz)):
        cell = cell_of_point[i]
        order[starts[cell + 1]] = i
        starts[cell + 1] += 1


@compiled(
    *(in_array(types.float32, 2), *_COLUMNS),
    *(out_array(types.float32, 2), out_array(types.float32, 2), out_array(types.float32), out_array(types.int32)),
    *(out_array(types.int32), out_array(types.int32)),
)
def _farthest_points(
    xyz: _Floats,
    order: _Integers,
    starts: _Integers,
    x_low: float,
    y_low: float,
    per_m: float,
    ny: int,
    nx: int,
    sorted_points: _Floats,
    boxes: _Floats,
    largest: _Floats,
    best: _Integers,
    best_of_row: _Integers,
    chosen: _Integers,
) -> int:
    """Choose sample after sample, each the farthest from those before it.

    `sorted_points`: x, y, z and squared distance to the nearest sample, in `order`. For each column, `boxes`: bounds of
    its points, low and high; `largest`: of their distances, and `best`: its index.

    A column is visited only if its box is nearer to the new sample than the largest distance in it; rounding keeps
    distances in order, so none is missed.
    """
    xs, ys, zs, nearest = sorted_points[0], sorted_points[1], sorted_points[2], sorted_points[3]
    for k in range(len(order)):
        i = order[k]
        xs[k], ys[k], zs[k], nearest[k] = xyz[i, 0], xyz[i, 1], xyz[i, 2], np.inf
    for cell in range(ny * nx):
        boxes[cell, 0:3] = np.inf
        boxes[cell, 3:6] = -np.inf
        largest[cell], best[cell] = -1, 0
        if starts[cell] < starts[cell + 1]:
            largest[cell], best[cell] = np.inf, starts[cell]
        for k in range(starts[cell], starts[cell + 1]):
            boxes[cell, 0], boxes[cell, 3] = min(boxes[cell, 0], xs[k]), max(boxes[cell, 3], xs[k])
            boxes[cell, 1], boxes[cell, 4] = min(boxes[cell, 1], ys[k]), max(boxes[cell, 4], ys[k])
            boxes[cell, 2], boxes[cell, 5] = min(boxes[cell, 2], zs[k]), max(boxes[cell, 5], zs[k])
    chosen[0] = 0
    farthest = np.float32(np.inf)
    for sampled in range(1, len(chosen)):
        last = chosen[sampled - 1]
        x, y, z = xyz[last, 0], xyz[last, 1], xyz[last, 2]
        # No point is farther from its sample than `farthest`, so none that stands farther off can change.
        reach = np.float32(1.001) * math.sqrt(farthest) + np.float32(0.001) * (abs(x) + abs(y) + 1)
        first_row, last_row = max(_column(y - reach, y_low, per_m), 0), min(_column(y + reach, y_low, per_m), ny - 1)
        first, end = max(_column(x - reach, x_low, per_m), 0), min(_column(x + reach, x_low, per_m), nx - 1) + 1
        for row in range(first_row, last_row + 1):
            changed = sampled == 1
            for cell in range(row * nx + first, row * nx + end):
                dx = max(boxes[cell, 0] - x, x - boxes[cell, 3], np.float32(0))
                dy = max(boxes[cell, 1] - y, y - boxes[cell, 4], np.float32(0))
                dz = max(boxes[cell, 2] - z, z - boxes[cell, 5], np.float32(0))
                if dx * dx + dy * dy + dz * dz >= largest[cell]:
                    continue
                changed = True
                most, place = np.float32(-1), 0
                for k in range(starts[cell], starts[cell + 1]):
                    dx, dy, dz = xs[k] - x, ys[k] - y, zs[k] - z
                    distance = min(nearest[k], dx * dx + dy * dy + dz * dz)
                    nearest[k] = distance
                    if distance > most:
                        most, place = distance, k
                largest[cell], best[cell] = most, place
            if changed:  # the comparison is written out twice: a call of it takes longer than all the rest
                top = row * nx
                for cell in range(row * nx + 1, row * nx + nx):
                    if largest[cell] > largest[top] or (
                        largest[cell] == largest[top] and order[best[cell]] < order[best[top]]
                    ):
                        top = cell
                best_of_row[row] = top
        top = best_of_row[0]
        for row in range(1, ny):
            cell = best_of_row[row]
            if largest[cell] > largest[top] or (largest[cell] == largest[top] and order[best[cell]] < order[best[top]]):
                top = cell
        farthest = largest[top]
        if farthest == 0:
            return sampled
        chosen[sampled] = order[best[top]]
    return len(chosen)


@compiled(
    *(in_array(types.float32, 2), in_array(types.float32, 2), in_array(types.float32)),
    *(types.float32, types.float32, types.float32, types.float32),
    *(out_array(types.int32, 2), out_array(types.int32, 2), out_array(types.float32, 2)),
)
def _near_circles(
    points: _Floats,
    centers: _Floats,
    squared: _Floats,
    x_low: float,
    y_low: float,
    cell_m: float,
    slack: float,
    heads: _Integers,
    links: _Integers,
    near: _Floats,
) -> int:
    """Kernel of `near_circles`; `heads`: state of a cell (covered, none near), or its first entry in `links`.

    `links`: linked lists of circles whose border may cross the cell: circle, next entry.
    """
    ny, nx = heads.shape
    used = 0
    for circle in range(len(centers)):
        x, y, reach = centers[circle, 0], centers[circle, 1], math.sqrt(squared[circle])
        outer, inner_reach = reach + slack, max(reach - slack, 0.0)
        first_row, last_row = max(int((y - outer - y_low) / cell_m), 0), min(int((y + outer - y_low) / cell_m), ny - 1)
        first, last = max(int((x - outer - x_low) / cell_m), 0), min(int((x + outer - x_low) / cell_m), nx - 1)
        for row in range(first_row, last_row + 1):
            low = y_low + row * cell_m - y
            near_y, far_y = max(low, -low - cell_m, 0.0), max(-low, low + cell_m)
            for column in range(first, last + 1):
                left = x_low + column * cell_m - x
                near_x, far_x = max(left, -left - cell_m, 0.0), max(-left, left + cell_m)
                if far_x * far_x + far_y * far_y < inner_reach * inner_reach:
                    heads[row, column] = _COVERED
                elif heads[row, column] != _COVERED and near_x * near_x + near_y * near_y < outer * outer:
                    links[used, 0], links[used, 1] = circle, heads[row, column]
                    heads[row, column] = used
                    used += 1
    per_m = np.float32(1) / cell_m
    count = 0
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        along_x, along_y = (x - x_low) * per_m, (y - y_low) * per_m
        if not (0 <= along_x < nx and 0 <= along_y < ny):
            continue
        link = heads[int(along_y), int(along_x)]
        while link >= 0:
            dx, dy = x - centers[links[link, 0], 0], y - centers[links[link, 0], 1]
            link = _COVERED if dx * dx + dy * dy < squared[links[link, 0]] else links[link, 1]
        if link == _COVERED:
            near[count, 0], near[count, 1], near[count, 2], near[count, 3] = x, y, points[i, 2], points[i, 3]
            count += 1
    return count


def _read_map(rows: NDArray[Any], cells: _Integers, weights: _Floats, read: _Floats) -> None:
    for k in range(len(cells)):
        for corner in range(cells.shape[1]):
            cell, weight = cells[k, corner], weights[k, corner]
            for channel in range(rows.shape[1]):
                read[k, channel] += np.float32(rows[cell, channel]) * weight


_PLACES = in_array(types.int32, 2), in_array(types.float32, 2), out_array(types.float32, 2)
_read_floats = compiled(in_array(types.float32, 2), *_PLACES)(_read_map)
_read_steps = compiled(in_array(types.uint8, 2), *_PLACES)(_read_map)
