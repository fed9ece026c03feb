"""Which points VectorPool interpolates: the three nearest to each cell of a cube around a query.

Index N, one past the last point, stands for nothing, as in `ball_query`.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.kernels import load_kernels
from asca_pillars.ops.points.ball_query import KERNELS
from asca_pillars.ops.points.columns import require_points, sort_into_columns

_NEAREST = 3
_ROUNDING = 1e-2  # of a column: how far float32 may misplace a point that stands on a border
_DISTANCES_AT_ONCE = 1 << 22


def cube_cells_m(half_length_m: float, cells: int) -> NDArray[np.float32]:
    """Centers of the cells of a cube, seen from its own: (cells^3, 3) metres; z varies fastest, x slowest."""
    share = (np.indices((cells, cells, cells)).reshape(3, -1).T + 0.5) * (2 / cells) - 1
    return np.ascontiguousarray(half_length_m * share, np.float32)


def nearest_in_cubes(
    points: NDArray[Any], queries: NDArray[Any], half_length_m: float, cells: int
) -> NDArray[np.int32]:
    """The three points nearest to each cell of a cube around each query: (N, 3), (Q, 3) -> (Q, cells^3, 3) indices.

    Points count that are less than twice the half length away from the query along every axis (VectorPool; AV PV-RCNN,
    eq. 12 and 13). Nearest first, of equally near ones the earlier; with fewer than three points the rest is index N.

    Args:
        points: (N, >=3) finite x, y, z in metres; N may be 0.
        queries: (Q, >=3) finite x, y, z in metres, anywhere.
        half_length_m: half the length of the cube, whose edges are along the axes.
        cells: of the cube along each axis.

    Raises:
        ValueError: another shape, or a coordinate that is not finite.
    """
    xyz, centers = require_points(points), require_points(queries)
    offsets, reach_m = cube_cells_m(half_length_m, cells), np.float32(2 * half_length_m)
    kernels = load_kernels(KERNELS)
    if kernels is None:
        return _nearest_in_cubes(xyz[:, :3], centers[:, :3], offsets, reach_m)
    columns = sort_into_columns(xyz, float(reach_m))
    around = (centers[:, 1::-1].astype(np.float64) - columns.origin_m[::-1]) * float(columns.per_m)  # row, column
    reach = float(reach_m) * float(columns.per_m) + _ROUNDING
    most = np.array(columns.shape) - 1
    first = np.floor(np.maximum(around - reach, 0)).clip(max=most + 1).astype(np.int64)
    last = np.floor(np.minimum(around + reach, most)).clip(min=-1).astype(np.int64)
    return np.asarray(kernels.nearest_in_cubes(xyz, centers, columns, first, last, offsets, reach_m))


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
