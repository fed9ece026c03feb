"""Compiled loops of `pillarize`, which tests/ops/numpy_kernels.py has in NumPy, and of the PFN layer.

Indices are unsigned where it matters: for signed ones, numba checks for negative values, which count from the end.
"""

from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from asca_pillars.base.compiling import compiled, in_array, inner, out_array
from asca_pillars.ops.pillar.grid import PillarGrid

_Floats = NDArray[np.float32]
_Integers = NDArray[np.int64]
_Counts = NDArray[np.uint32]
_Bools = NDArray[np.bool_]

_BLOCK = 16  # cells of the grid that are looked at together


def sort_points(points: _Floats, grid: PillarGrid) -> tuple[_Counts, _Integers, _Integers]:
    """Compute `numpy_kernels._sort_points` by counting: (N, 4) -> indices (K,) of points inside, cells, counts (Q,)."""
    size = -(-grid.ny * grid.nx // _BLOCK) * _BLOCK
    # In one piece: glibc gives several pieces back to the system, and gets them page by page again for the next scan.
    memory = np.empty(5 * len(points) + size, np.uint32)
    tally, rows = memory[:size], memory[size:].reshape(5, len(points))
    order, cells, counts = rows[2:]
    inside, pillars = _sort_points(points, *grid.tables, tally, *rows)
    return order[:inside], cells[:pillars].astype(np.int64), counts[:pillars].astype(np.int64)


@inner
def _interval(value: float, edges: _Floats, per_m: float) -> Any:
    """Compute `grid._interval` of one value."""
    guess = np.uint64(min(int((value - edges[0]) * per_m), len(edges) - 2))
    if value < edges[guess]:
        return guess - np.uint64(1)
    if value >= edges[guess + np.uint64(1)]:
        return guess + np.uint64(1)
    return guess


@compiled(
    *(in_array(types.float32, 2), in_array(types.float32, 2), in_array(types.float32), in_array(types.int64)),
    *(in_array(types.float32), *(out_array(types.uint32) for _ in range(6))),
)
def _sort_points(
    points: _Floats,
    ranges_m: _Floats,
    slice_edges_m: _Floats,
    column_of_slice: _Integers,
    row_edges_m: _Floats,
    tally: _Counts,
    chosen: _Counts,
    cell_of_chosen: _Counts,
    order: _Counts,
    cells: _Counts,
    counts: _Counts,
) -> tuple[int, int]:
    x_low, x_high, y_low, y_high = ranges_m[0, 0], ranges_m[0, 1], ranges_m[1, 0], ranges_m[1, 1]
    z_low, z_high = ranges_m[2, 0], ranges_m[2, 1]
    inside = 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        chosen[inside] = i
        # Without branches: which points are inside is hard to predict.
        inside += (x >= x_low) & (x < x_high) & (y >= y_low) & (y < y_high) & (z >= z_low) & (z < z_high)

    slices_per_m = np.float32(len(slice_edges_m) - 1) / (slice_edges_m[-1] - slice_edges_m[0])
    rows_per_m = np.float32(len(row_edges_m) - 1) / (row_edges_m[-1] - row_edges_m[0])
    columns = np.uint64(column_of_slice[-1] + 1)
    pillars = 0
    tally[:] = 0
    for k in range(inside):
        x, y = points[chosen[k], 0], points[chosen[k], 1]
        column = np.uint64(column_of_slice[_interval(x, slice_edges_m, slices_per_m)])
        cell = _interval(y, row_edges_m, rows_per_m) * columns + column
        cell_of_chosen[k] = cell
        pillars += tally[cell] == 0
        tally[cell] += 1

    pillar = position = 0
    for block in range(0, len(tally), _BLOCK):
        occupied = 0
        for cell in range(block, block + _BLOCK):
            occupied |= tally[cell]
        if not occupied:  # most blocks are empty, and a block is tested at once
            continue
        for cell in range(block, block + _BLOCK):
            count = tally[cell]
            if count:
                cells[pillar] = cell
                counts[pillar] = count
                pillar += 1
                tally[cell] = position  # from here on: where the cell's next point goes
                position += count
    for k in range(inside):
        cell = cell_of_chosen[k]
        order[tally[cell]] = chosen[k]
        tally[cell] += 1
    return inside, pillars


def fill_pillars(
    points: _Floats,
    order: _Counts,
    cells: _Integers,
    counts: _Integers,
    kept: _Bools,
    max_points: int,
    grid: PillarGrid,
) -> tuple[_Floats, _Integers, _Integers]:
    """Compute `numpy_kernels._fill_pillars`, in one pass: features (M, 9), pillar indices (M,), point counts (P,)."""
    point_counts = np.minimum(counts[kept], max_points)
    features = np.empty((point_counts.sum(), 9), np.float32)
    pillar_index = np.empty(len(features), np.int64)
    centers_m = grid.column_centers_m, grid.row_centers_m
    _fill_pillars(points, order, cells, counts, kept, max_points, *centers_m, features, pillar_index)
    return features, pillar_index, point_counts


@compiled(
    *(in_array(types.float32, 2), in_array(types.uint32), in_array(types.int64), in_array(types.int64)),
    *(in_array(types.boolean), types.int64, in_array(types.float32), in_array(types.float32)),
    *(out_array(types.float32, 2), out_array(types.int64)),
)
def _fill_pillars(
    points: _Floats,
    order: _Counts,
    cells: _Integers,
    counts: _Integers,
    kept: _Bools,
    max_points: int,
    column_centers_m: _Floats,
    row_centers_m: _Floats,
    features: _Floats,
    pillar_index: _Integers,
) -> None:
    end = first = place = 0
    for pillar in range(len(counts)):
        start = end
        end += counts[pillar]
        if not kept[pillar]:
            continue
        row, share, most = first, 0, min(max_points, end - start)
        x_sum = y_sum = z_sum = 0.0
        for position in range(start, end):
            share += most
            if share >= end - start:
                share -= end - start
                i = order[position]
                for channel in range(4):
                    features[row, channel] = points[i, channel]
                x_sum += points[i, 0]
                y_sum += points[i, 1]
                z_sum += points[i, 2]
                row += 1
        count = row - first
        x_mean, y_mean, z_mean = np.float32(x_sum / count), np.float32(y_sum / count), np.float32(z_sum / count)
        x_center = column_centers_m[cells[pillar] % len(column_centers_m)]
        y_center = row_centers_m[cells[pillar] // len(column_centers_m)]
        for k in range(first, row):
            features[k, 4] = features[k, 0] - x_mean
            features[k, 5] = features[k, 1] - y_mean
            features[k, 6] = features[k, 2] - z_mean
            features[k, 7] = features[k, 0] - x_center
            features[k, 8] = features[k, 1] - y_center
            pillar_index[k] = place
        place += 1
        first = row


def pfn_maxima(features: _Floats, point_counts: _Integers, weight: _Floats, bias: _Floats) -> _Floats:
    """Compute the PFN layer: max over each pillar's points of ReLU(features @ weight + bias). Paper section 3.2.

    The products of a whole scan, 15 MB for 64 channels, are never stored: that is what a graph spends its time on.

    Args:
        features: (M, 9), the rows of one pillar adjacent.
        point_counts: (P,) rows of each pillar.
        weight: (9, C).
        bias: (C,).

    Returns:
        (P, C)
    """
    maxima = np.empty((len(point_counts), len(bias)), np.float32)
    _pfn_maxima(features, point_counts, weight.reshape(9 * len(bias)), bias, maxima)
    return maxima


@compiled(
    *(in_array(types.float32, 2), in_array(types.int64), in_array(types.float32), in_array(types.float32)),
    out_array(types.float32, 2),
    fastmath={"contract"},  # a product and its sum in one instruction
)
def _pfn_maxima(features: _Floats, point_counts: _Integers, weight: _Floats, bias: _Floats, maxima: _Floats) -> None:
    channels = len(bias)
    largest = np.empty(channels, np.float32)
    row = 0
    for pillar in range(len(point_counts)):
        end = row + point_counts[pillar]
        for channel in range(channels):
            largest[channel] = -bias[channel]  # ReLU(x + bias) is max(x, -bias) + bias
        while row < end:
            for channel in range(channels):
                product = np.float32(0)
                for k in range(9):
                    product += features[row, k] * weight[k * channels + channel]
                largest[channel] = max(product, largest[channel])
            row += 1
        for channel in range(channels):
            maxima[pillar, channel] = largest[channel] + bias[channel]
