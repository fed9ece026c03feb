"""Which points a set abstraction aggregates: those within a ball around each query (PointNet++), and the nearest three.

Index N, one past the last point, stands for nothing: whoever gathers rows appends a row of zeros.
"""

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.kernels import load_kernels
from asca_pillars.ops.points.columns import require_points, sort_into_columns

KERNELS = "asca_pillars.ops.points.ball_kernels"
# A column is a little narrower than a quarter of the radius: a ball has about 69 columns, and the first visited do not
# all lie on one side. Of many points at least eight columns get a share.
_COLUMNS_PER_RADIUS = 4.01
_COLUMNS_TO_FILL = 8
_ROUNDING = 1e-3  # of a column: how far float32 may misplace a point that stands on a border


def ball_query(points: NDArray[Any], queries: NDArray[Any], radius_m: float, samples: int) -> NDArray[np.int32]:
    """For each query the indices of up to `samples` points nearer than the radius: (N, 3), (Q, 3) -> (Q, samples).

    A ball of fewer points has them as they are stored, then its first one again and again; one without any has N.

    The columns of a full ball are visited in a pseudo-random order that depends on their number alone, the points of a
    column as they are stored, and the first `samples` found are taken: at first no more than an eighth of them from one
    column, then, if that is not enough, the others. PointNet++ takes the first in the order of storage, which in a scan
    are all of one ring.

    Args:
        points: (N, >=3) finite x, y, z in metres; N may be 0.
        queries: (Q, >=3) finite x, y, z in metres, anywhere.
        radius_m: squared distances in float32 must be below its square.

    Raises:
        ValueError: another shape, or a coordinate that is not finite.
    """
    xyz, centers = require_points(points), require_points(queries)
    columns = sort_into_columns(xyz, radius_m / _COLUMNS_PER_RADIUS)
    offsets = _visiting_order(radius_m * float(columns.per_m))
    squared = np.float32(radius_m) * np.float32(radius_m)
    query = load_kernels(KERNELS).ball_query
    return np.asarray(query(xyz, centers, columns, offsets, squared, samples, -(-samples // _COLUMNS_TO_FILL)))


def three_nearest(points: NDArray[Any], queries: NDArray[Any]) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """The three points nearest to each query and their weights: (N, 3), (Q, 3) -> (Q, 3) indices, (Q, 3) weights.

    Weights are inverse distances that sum to 1 (PointNet++, section 3.4). Nearest first, of equally near ones the
    earlier; with fewer than three points the rest is index N with weight 0.

    Raises:
        ValueError: another shape, or a coordinate that is not finite.
    """
    xyz, centers = require_points(points), require_points(queries)
    column_m = math.sqrt(_area_m2(xyz) / max(len(xyz), 1)) + 1e-3  # about one point in each
    nearest, squared = load_kernels(KERNELS).three_nearest(xyz, centers, sort_into_columns(xyz, column_m))
    found = nearest < len(xyz)
    weights = np.where(found, 1 / (np.sqrt(squared) + np.float32(1e-8)), np.float32(0))
    total = weights.sum(axis=1, keepdims=True)
    return nearest, np.divide(weights, total, out=np.zeros_like(weights), where=total > 0)


@lru_cache(maxsize=64)  # the radius in columns follows the scan where that is wide
def _visiting_order(radius: float) -> NDArray[np.int32]:
    """(row, column) offsets (M, 2) of the columns that a ball of so many columns' radius can reach, shuffled."""
    reach = math.ceil(radius + _ROUNDING)
    offsets = np.indices((2 * reach + 1, 2 * reach + 1)).reshape(2, -1).T - reach
    gap = np.maximum(np.abs(offsets) - 1 - _ROUNDING, 0)
    offsets = offsets[np.hypot(*gap.T) < radius]
    order = np.random.Generator(np.random.PCG64(len(offsets))).random(len(offsets)).argsort()
    offsets = offsets[order].astype(np.int32)
    offsets.flags.writeable = False
    return offsets


def _area_m2(xyz: NDArray[np.float32]) -> float:
    if not len(xyz):
        return 0.0
    return float(np.prod(np.ptp(xyz[:, :2].astype(np.float64), axis=0)))
