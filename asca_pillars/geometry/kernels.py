"""The loops of `pillarize` and `rotated_nms`, compiled by numba. What they compute is said there, in NumPy.

Imported by `load_kernels`. The signatures are written out, so that everything is compiled at import, once per machine
(numba's cache keeps it), and nothing again for another memory layout. `nogil` lets other threads run meanwhile;
nothing is `parallel`, because the network owns the cores.
"""

import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba import types
from numpy.typing import NDArray

_Floats = NDArray[np.float32]
_Doubles = NDArray[np.float64]
_Integers = NDArray[np.int64]

_FLOATS = types.Array(types.float32, 1, "C", readonly=True)
_FLOAT_ROWS = types.Array(types.float32, 2, "C", readonly=True)
_DOUBLE_ROWS = types.Array(types.float64, 2, "C", readonly=True)
_INTEGERS = types.Array(types.int64, 1, "C", readonly=True)
_SHORTS = types.Array(types.int32, 1, "C", readonly=True)
_BOOLS = types.Array(types.boolean, 1, "C", readonly=True)


def _compile(*arguments: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """`numba.njit` for arguments of these types, cached where a folder for it can be written."""

    def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
        # NumPy's division: nothing here divides by zero and raises.
        options = {"nogil": True, "error_model": "numpy"}
        try:
            return numba.njit(arguments, cache=True, **options)(function)
        except RuntimeError:  # no such folder: every process compiles for two seconds, and detects as fast as others
            return numba.njit(arguments, **options)(function)

    return compiled


@_compile(_FLOAT_ROWS, _FLOAT_ROWS, _FLOATS, _INTEGERS, _FLOATS)
def sort_points(
    points: _Floats, ranges_m: _Floats, slice_edges_m: _Floats, column_of_slice: _Integers, row_edges_m: _Floats
) -> tuple[NDArray[np.int32], _Integers, _Integers]:
    """`PillarGrid.cells` of (N, 4) points and a counting sort by it; arguments after the points as in GridTables.

    Returns the indices of the M points inside, sorted by cell, and the Q occupied cells with the points of each.
    """
    x_low, x_high, y_low, y_high = ranges_m[0, 0], ranges_m[0, 1], ranges_m[1, 0], ranges_m[1, 1]
    z_low, z_high = ranges_m[2, 0], ranges_m[2, 1]
    inside = 0
    chosen = np.empty(len(points), np.int32)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        chosen[inside] = i
        # Without branches: which points are inside is hard to predict.
        inside += (x >= x_low) & (x < x_high) & (y >= y_low) & (y < y_high) & (z >= z_low) & (z < z_high)

    slices, rows, columns = len(column_of_slice), len(row_edges_m) - 1, column_of_slice[-1] + 1
    slices_per_m = np.float32(slices) / (slice_edges_m[-1] - slice_edges_m[0])
    rows_per_m = np.float32(rows) / (row_edges_m[-1] - row_edges_m[0])
    cell_of_chosen = np.empty(inside, np.int32)
    tally = np.zeros(rows * columns, np.int32)
    found = 0
    for k in range(inside):
        x, y = points[chosen[k], 0], points[chosen[k], 1]
        part = min(int((x - slice_edges_m[0]) * slices_per_m), slices - 1)
        row = min(int((y - row_edges_m[0]) * rows_per_m), rows - 1)
        # The products round; the borders decide.
        part -= x < slice_edges_m[part]
        part += x >= slice_edges_m[part + 1]
        row -= y < row_edges_m[row]
        row += y >= row_edges_m[row + 1]
        cell = row * columns + column_of_slice[part]
        cell_of_chosen[k] = cell
        found += tally[cell] == 0
        tally[cell] += 1

    cells, counts = np.empty(found, np.int64), np.empty(found, np.int64)
    pillar = position = 0
    for cell in range(len(tally)):
        count = tally[cell]
        if count:
            cells[pillar] = cell
            counts[pillar] = count
            pillar += 1
            tally[cell] = position  # from here on: where the cell's next point goes
            position += count
    order = np.empty(inside, np.int32)
    for k in range(inside):
        cell = cell_of_chosen[k]
        order[tally[cell]] = chosen[k]
        tally[cell] += 1
    return order, cells, counts


@_compile(_FLOAT_ROWS, _SHORTS, _INTEGERS, _INTEGERS, _BOOLS, _INTEGERS, types.int64, _FLOATS, _FLOATS)
def fill_pillars(
    points: _Floats,
    order: NDArray[np.int32],
    cells: _Integers,
    counts: _Integers,
    kept: NDArray[np.bool_],
    shuffled: _Integers,
    max_points: int,
    column_centres_m: _Floats,
    row_centres_m: _Floats,
) -> tuple[_Floats, _Integers, _Integers]:
    """`pillarize._fill_pillars`: features (M, 9), pillar index (M,) and points per pillar (P,) of what is kept."""
    crowd, crowd_pillar = np.empty(len(shuffled), np.int64), np.empty(len(shuffled), np.int64)
    pillars = total = start = crowded = 0
    for pillar in range(len(counts)):
        count = counts[pillar]
        if kept[pillar]:
            pillars += 1
            total += min(count, max_points)
            if count > max_points:
                for position in range(start, start + count):
                    crowd[crowded] = position
                    crowd_pillar[crowded] = pillar
                    crowded += 1
        start += count
    stays = np.ones(len(order), np.bool_)
    taken = np.zeros(len(counts), np.int64)
    for index in shuffled:
        pillar = crowd_pillar[index]
        stays[crowd[index]] = taken[pillar] < max_points
        taken[pillar] += 1

    features = np.empty((total, 9), np.float32)
    pillar_index, point_counts = np.empty(total, np.int64), np.empty(pillars, np.int64)
    start = first = place = 0
    for pillar in range(len(counts)):
        end = start + counts[pillar]
        if kept[pillar]:
            row = first
            x_sum = y_sum = z_sum = 0.0
            for position in range(start, end):
                if stays[position]:
                    i = order[position]
                    for channel in range(4):
                        features[row, channel] = points[i, channel]
                    x_sum += points[i, 0]
                    y_sum += points[i, 1]
                    z_sum += points[i, 2]
                    row += 1
            count = row - first
            x_mean, y_mean, z_mean = np.float32(x_sum / count), np.float32(y_sum / count), np.float32(z_sum / count)
            x_centre = column_centres_m[cells[pillar] % len(column_centres_m)]
            y_centre = row_centres_m[cells[pillar] // len(column_centres_m)]
            for k in range(first, row):
                features[k, 4] = features[k, 0] - x_mean
                features[k, 5] = features[k, 1] - y_mean
                features[k, 6] = features[k, 2] - z_mean
                features[k, 7] = features[k, 0] - x_centre
                features[k, 8] = features[k, 1] - y_centre
                pillar_index[k] = place
            point_counts[place] = count
            place += 1
            first = row
        start = end
    return features, pillar_index, point_counts


@numba.njit(error_model="numpy")
def _shared_area(x: float, y: float, cos: float, sin: float, al: float, aw: float, bl: float, bw: float) -> float:
    """`paired_bev_intersection` for a of half extents al, aw, seen from b of half extents bl, bw."""
    cos_abs, sin_abs = abs(cos), abs(sin)
    if (
        abs(x) >= bl + cos_abs * al + sin_abs * aw
        or abs(y) >= bw + sin_abs * al + cos_abs * aw
        or abs(cos * x + sin * y) >= al + cos_abs * bl + sin_abs * bw
        or abs(cos * y - sin * x) >= aw + sin_abs * bl + cos_abs * bw
    ):
        return 0.0
    area = 0.0
    along, across = al, aw
    x0, y0 = x + cos * along - sin * across, y + sin * along + cos * across
    for corner in range(4):
        if corner % 2 == 0:
            along = -along
        else:
            across = -across
        x1, y1 = x + cos * along - sin * across, y + sin * along + cos * across
        left, right = max(-bl, min(x0, bl)), max(-bl, min(x1, bl))
        y_left = y0 + (y1 - y0) * _share(left - x0, x1 - x0)
        y_right = y1 - (y1 - y0) * _share(x1 - right, x1 - x0)
        low, high = max(-bw, min(y_left, bw)), max(-bw, min(y_right, bw))
        before = _share(abs(y_left - low), abs(y_right - y_left))
        after = _share(abs(y_right - high), abs(y_right - y_left))
        area -= (right - left) * ((low + high) / 2 + (before - after) * (low - high) / 2)
        x0, y0 = x1, y1
    return max(0.0, min(area, 4 * min(al * aw, bl * bw)))


@numba.njit(error_model="numpy")
def _share(part: float, whole: float) -> float:
    return max(part / whole, 0.0) if abs(part) < abs(whole) else 1.0


@_compile(_DOUBLE_ROWS, types.float64, types.int64)
def suppress(boxes: _Doubles, iou_threshold: float, limit: int) -> _Integers:
    """`rotated_nms` of boxes (N, 7) that come best first."""
    places = np.empty((len(boxes), 3))  # x, y and radius of the kept boxes' circles: what most comparisons need
    rest = np.empty((len(boxes), 5))  # half length, half width, area, cosine, sine
    kept = np.empty(len(boxes), np.int64)
    count = 0
    for i in range(len(boxes)):
        if count == limit:
            break
        x, y, length, width = boxes[i, 0], boxes[i, 1], boxes[i, 3], boxes[i, 4]
        cos, sin, reach = math.cos(boxes[i, 6]), math.sin(boxes[i, 6]), math.hypot(length, width)
        clashes = False
        for k in range(count):
            dx, dy = places[k, 0] - x, places[k, 1] - y
            reaches = places[k, 2] + reach
            if 4 * (dx * dx + dy * dy) < reaches * reaches:
                al, aw, bl, bw = rest[k, 0], rest[k, 1], length / 2, width / 2
                turn_cos, turn_sin = rest[k, 3] * cos + rest[k, 4] * sin, rest[k, 4] * cos - rest[k, 3] * sin
                shared = _shared_area(cos * dx + sin * dy, cos * dy - sin * dx, turn_cos, turn_sin, al, aw, bl, bw)
                union = rest[k, 2] + length * width - shared
                if union > 0 and shared / union > iou_threshold:
                    clashes = True
                    break
        if not clashes:
            places[count, 0], places[count, 1], places[count, 2] = x, y, reach
            rest[count, 0], rest[count, 1], rest[count, 2] = length / 2, width / 2, length * width
            rest[count, 3], rest[count, 4] = cos, sin
            kept[count] = i
            count += 1
    return kept[:count]
