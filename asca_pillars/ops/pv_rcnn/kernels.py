"""Compiled loops of `voxelize`."""

import math

import numpy as np
from numba import types
from numpy.typing import NDArray

from asca_pillars.base.compiling import compiled, in_array, out_array
from asca_pillars.ops.sparse.kernels import bits_of, bits_set
from asca_pillars.ops.sparse.rulebooks import Shape

_Floats = NDArray[np.float32]
_Integers = NDArray[np.int64]
_Masks = NDArray[np.uint64]

_ONE, _SHAPE = np.uint64(1), types.UniTuple(types.int64, 3)
_EDGES = (*(in_array(types.float32),) * 3, in_array(types.int64))


@compiled(in_array(types.float32, 2), *_EDGES, _SHAPE, out_array(types.int64))
def cells_of_points(
    points: _Floats,
    lows_m: _Floats,
    highs_m: _Floats,
    sizes_m: _Floats,
    last: _Integers,
    shape: Shape,
    cells: _Integers,
) -> None:
    """Find the voxel of each point, -1 outside: (M, >=3) in metres -> flat indices (M,)."""
    for i in range(len(points)):
        cells[i] = -1
        if (
            lows_m[0] <= points[i, 0] < highs_m[0]
            and lows_m[1] <= points[i, 1] < highs_m[1]
            and lows_m[2] <= points[i, 2] < highs_m[2]
        ):
            x = min(math.floor((points[i, 0] - lows_m[0]) / sizes_m[0]), last[0])
            y = min(math.floor((points[i, 1] - lows_m[1]) / sizes_m[1]), last[1])
            z = min(math.floor((points[i, 2] - lows_m[2]) / sizes_m[2]), last[2])
            cells[i] = (y * shape[2] + x) * shape[0] + z


@compiled(
    in_array(types.float32, 2),
    in_array(types.int64),
    types.int64,
    in_array(types.uint64),
    in_array(types.int32),
    types.int64,
    *(out_array(types.float64, 2), out_array(types.int64), out_array(types.float32, 2)),
)
def sum_points(
    points: _Floats,
    cells: _Integers,
    nz: int,
    mask: _Masks,
    start: NDArray[np.int32],
    max_points: int,
    sums: NDArray[np.float64],
    counts: _Integers,
    means: _Floats,
) -> None:
    """Mean of the first points of each voxel: (M, C) -> (N, C); `sums` and `counts` come as zeros."""
    for i in range(len(points)):
        if cells[i] < 0:
            continue
        column = cells[i] // nz
        below = bits_of(mask, start, np.uint64(column)) & ((_ONE << np.uint64(cells[i] - column * nz)) - _ONE)
        voxel = start[column] + bits_set(below)
        if counts[voxel] < max_points:
            counts[voxel] += 1
            for channel in range(points.shape[1]):
                sums[voxel, channel] += points[i, channel]
    for voxel in range(len(counts)):
        for channel in range(points.shape[1]):
            means[voxel, channel] = sums[voxel, channel] / counts[voxel]
