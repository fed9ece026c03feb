"""Which points VectorPool interpolates: the three nearest to each cell of a cube around a query.

Index N, one past the last point, stands for nothing, as in `ball_query`.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.kernels import load_kernels
from asca_pillars.ops.points.ball_query import KERNELS
from asca_pillars.ops.points.columns import require_points, sort_into_columns

_ROUNDING = 1e-2  # of a column: how far float32 may misplace a point that stands on a border


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
    columns = sort_into_columns(xyz, float(reach_m))
    around = (centers[:, 1::-1].astype(np.float64) - columns.origin_m[::-1]) * float(columns.per_m)  # row, column
    reach = float(reach_m) * float(columns.per_m) + _ROUNDING
    most = np.array(columns.shape) - 1
    first = np.floor(np.maximum(around - reach, 0)).clip(max=most + 1).astype(np.int64)
    last = np.floor(np.minimum(around + reach, most)).clip(min=-1).astype(np.int64)
    return np.asarray(load_kernels(KERNELS).nearest_in_cubes(xyz, centers, columns, first, last, offsets, reach_m))
