"""The loops of sorting and sampling, compiled; what they compute is said in `columns` and `farthest_points`."""

import math
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from asca_pillars.geometry.compiling import compiled, given, inner, written
from asca_pillars.points.columns import Columns

_Floats = NDArray[np.float32]
_Integers = NDArray[np.int32]
_Bools = NDArray[np.bool_]

_COLUMNS = (
    given(types.int32),
    given(types.int32),
    types.float32,
    types.float32,
    types.float32,
    types.int64,
    types.int64,
)


def sort(
    xyz: _Floats, x_low: np.float32, y_low: np.float32, per_m: np.float32, ny: int, nx: int
) -> tuple[_Integers, _Integers]:
    """`columns._sort`, by counting: (N, 3) in metres -> `Columns.order` (N,) and `Columns.starts` (ny * nx + 1,)."""
    order, starts = np.empty(len(xyz), np.int32), np.zeros(ny * nx + 1, np.int32)
    _sort(xyz, x_low, y_low, per_m, nx, np.empty(len(xyz), np.int32), order, starts)
    return order, starts


def farthest_points(xyz: _Floats, count: int, columns: Columns) -> _Integers:
    """`farthest_points._farthest_points`, column by column: (N, 3) in metres -> indices (S,), S at most `count`."""
    cells = len(columns.starts) - 1
    chosen = np.empty(min(count, len(xyz)), np.int32)
    found = _farthest_points(
        *(xyz, *_flat(columns)),
        *(np.empty((4, len(xyz)), np.float32), np.empty((cells, 6), np.float32), np.empty(cells, np.float32)),
        *(np.empty(cells, np.int32), np.empty(columns.shape[0], np.int32), chosen),
    )
    return chosen[:found]


def near_circles(x: _Floats, y: _Floats, centers: _Floats, squared: _Floats) -> _Bools:
    """Which points lie inside any of the circles: (N,), (N,), (R, 2) in metres, (R,) in m² -> (N,)."""
    near = np.zeros(len(x), np.bool_)
    _near_circles(x, y, np.ascontiguousarray(centers), squared, near)
    return near


def _flat(columns: Columns) -> tuple[Any, ...]:
    return columns.order, columns.starts, *columns.origin_m, columns.per_m, *columns.shape


@inner
def _column(value: Any, low: Any, per_m: Any) -> int:
    """`columns.cells_of` of one value."""
    return math.floor(min(max((value - low) * per_m, np.float32(-1e6)), np.float32(1e6)))


@compiled(
    *(given(types.float32, 2), types.float32, types.float32, types.float32, types.int64),
    *(written(types.int32), written(types.int32), written(types.int32)),
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
    *(given(types.float32, 2), *_COLUMNS),
    *(written(types.float32, 2), written(types.float32, 2), written(types.float32), written(types.int32)),
    *(written(types.int32), written(types.int32)),
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

    `sorted_points`: x, y, z and squared distance to the nearest sample, in `order`. Of each column, `boxes`: what
    bounds its points, low and high; `largest`: of their distances, and `best`: where.

    A column is looked into only if its box is nearer to the new sample than the largest distance in it; rounding keeps
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
    for found in range(1, len(chosen)):
        last = chosen[found - 1]
        x, y, z = xyz[last, 0], xyz[last, 1], xyz[last, 2]
        # No point is farther from its sample than `farthest`, so none that stands farther off can change.
        reach = np.float32(1.001) * math.sqrt(farthest) + np.float32(0.001) * (abs(x) + abs(y) + 1)
        first_row, last_row = max(_column(y - reach, y_low, per_m), 0), min(_column(y + reach, y_low, per_m), ny - 1)
        first, end = max(_column(x - reach, x_low, per_m), 0), min(_column(x + reach, x_low, per_m), nx - 1) + 1
        for row in range(first_row, last_row + 1):
            changed = found == 1
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
            return found
        chosen[found] = order[best[top]]
    return len(chosen)


@compiled(
    *(given(types.float32), given(types.float32), given(types.float32, 2), given(types.float32)),
    written(types.boolean),
)
def _near_circles(x: _Floats, y: _Floats, centers: _Floats, squared: _Floats, near: _Bools) -> None:
    for circle in range(len(centers)):
        center_x, center_y, limit = centers[circle, 0], centers[circle, 1], squared[circle]
        for i in range(len(x)):
            dx, dy = x[i] - center_x, y[i] - center_y
            near[i] |= dx * dx + dy * dy < limit
