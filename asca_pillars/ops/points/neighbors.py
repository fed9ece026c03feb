"""Neighbors of queries: in balls (PointNet++), the nearest three, in cells of cubes (VectorPool), at several scales.

Index N, one past the last point, stands for nothing: callers append a row of zeros before gathering.

Graphs read gathered points, or groups of balls of like size, faster than `ball_query`'s indices. A row of `ball_query`
repeats its first point where the ball holds fewer. The maximum over a ball is the same without the repetitions; on the
grids of proposals most of what the rows hold are repetitions.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.kernels import load_kernels
from asca_pillars.ops.points.sampling import require_points, sort_into_columns

KERNELS = "asca_pillars.ops.points.ball_kernels"
# A column is a little narrower than a quarter of the radius: a ball has about 69 columns, and the first visited do not
# all lie on one side. Of many points at least eight columns get a share.
_COLUMNS_PER_RADIUS = 4.01
_COLUMNS_TO_FILL = 8
_ROUNDING = 1e-3  # of a column: how far float32 may misplace a point that stands on a border


def ball_query(points: NDArray[Any], queries: NDArray[Any], radius_m: float, samples: int) -> NDArray[np.int32]:
    """Return up to `samples` indices of points within the radius of each query: (N, 3), (Q, 3) -> (Q, samples).

    A ball of fewer points holds them in the order of storage, then repeats its first one; an empty ball holds N.

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
    """Return three nearest points of each query, and weights: (N, 3), (Q, 3) -> (Q, 3) indices, (Q, 3) weights.

    Weights are inverse distances that sum to 1 (PointNet++, section 3.4). Nearest first, of equally near ones the
    earlier; with fewer than three points the rest is index N with weight 0.

    Raises:
        ValueError: another shape, or a coordinate that is not finite.
    """
    xyz, centers = require_points(points), require_points(queries)
    column_m = math.sqrt(_area_m2(xyz) / max(len(xyz), 1)) + 1e-3  # about one point in each
    nearest, squared = load_kernels(KERNELS).three_nearest(xyz, centers, sort_into_columns(xyz, column_m))
    exists = nearest < len(xyz)
    weights = np.where(exists, 1 / (np.sqrt(squared) + np.float32(1e-8)), np.float32(0))
    total = weights.sum(axis=1, keepdims=True)
    return nearest, np.divide(weights, total, out=np.zeros_like(weights), where=total > 0)


@lru_cache(maxsize=64)  # the radius in columns follows the scan where that is wide
def _visiting_order(radius: float) -> NDArray[np.int32]:
    """Return shuffled (row, column) offsets (M, 2) of the columns that a ball can reach; the radius is in columns."""
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


_CUBE_ROUNDING = 1e-2  # of a column: how far float32 may misplace a point that stands on a border


def cube_cells_m(half_length_m: float, cells: int) -> NDArray[np.float32]:
    """Return centers of the cells of a cube, relative to its own: (cells^3, 3) metres; z varies fastest, x slowest."""
    share = (np.indices((cells, cells, cells)).reshape(3, -1).T + 0.5) * (2 / cells) - 1
    return np.ascontiguousarray(half_length_m * share, np.float32)


def nearest_in_cubes(
    points: NDArray[Any], queries: NDArray[Any], half_length_m: float, cells: int
) -> NDArray[np.int32]:
    """Return three nearest points of each cell of a cube around each query: (N, 3), (Q, 3) -> (Q, cells^3, 3) indices.

    Only points within twice the half length of the query along every axis count (VectorPool; AV PV-RCNN, eq. 12 and
    13). Nearest first, of equally near ones the earlier; with fewer than three points the rest is index N.

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
    reach = float(reach_m) * float(columns.per_m) + _CUBE_ROUNDING
    most = np.array(columns.shape) - 1
    first = np.floor(np.maximum(around - reach, 0)).clip(max=most + 1).astype(np.int64)
    last = np.floor(np.minimum(around + reach, most)).clip(min=-1).astype(np.int64)
    return np.asarray(load_kernels(KERNELS).nearest_in_cubes(xyz, centers, columns, first, last, offsets, reach_m))


_FEWER = 4  # a scale has a quarter of the positions of the one before

Array = TypeVar("Array")


class PointScale(NamedTuple, Generic[Array]):
    """M positions with a group around each: of points on the finest scale, then of positions of the scale before.

    Of one scan (NumPy) or of a batch (tensors).
    """

    positions: Array
    """(M, 3), metres, LiDAR frame."""
    groups: Array
    """(M, samples) group of each position, see `ball_query`."""
    nearest: Array
    """Indices of the three nearest of these for each position of the next finer scale, (_, 3); (0, 3) for the
    finest."""
    nearest_weights: Array
    """Normalized inverse distances to `nearest`, sum 1."""


def point_scales(
    points: NDArray[np.float32], keypoints: NDArray[np.float32], radii_m: Sequence[float], samples: int
) -> tuple[PointScale[NDArray[Any]], ...]:
    """Return a scale for each radius, the finest first: all keypoints, the first quarter of them, the first sixteenth.

    Keypoints are in the order of farthest-point sampling, so that the first of them are those that sampling the
    keypoints again would give.

    Args:
        points: (N, >=3) finite, metres, LiDAR frame.
        keypoints: (K, 3) see `farthest_points`.
        radii_m: of the groups.
        samples: of each group at most.
    """
    scales: list[PointScale[NDArray[Any]]] = []
    finer, positions = points, keypoints
    for radius_m in radii_m:
        groups = ball_query(finer, positions, radius_m, samples)
        nearest, weights = three_nearest(positions, finer[:0] if not scales else finer)
        scales.append(PointScale(positions, groups, nearest, weights))
        finer, positions = positions, positions[: -(-len(positions) // _FEWER)]
    return tuple(scales)


_EIGHTHS = (1, 2, 4, 6, 8)  # widths as shares of the samples: one more would save less than its operators cost

Indices = TypeVar("Indices")


class BallGroup(NamedTuple, Generic[Indices]):
    """Group of balls with about as many points."""

    queries: Indices
    """(n,) query of each ball; Q for an empty ball."""
    members: Indices
    """(n, width) points of each ball, each of them at least once; N stands for nothing."""


class GroupedBalls(NamedTuple, Generic[Indices]):
    """The balls of Q queries."""

    groups: tuple[BallGroup[Indices], ...]
    """One group for each of `group_widths`, perhaps empty."""
    rows: Indices
    """(Q,) position of each query's ball in the concatenated groups."""


def group_widths(samples: int) -> tuple[int, ...]:
    """Return the widths of `members` in each group, ascending, for balls of up to `samples` points."""
    return tuple(sorted({-(-samples * eighths // 8) for eighths in _EIGHTHS}))


def group_balls(indices: NDArray[np.int32], count: int) -> GroupedBalls[NDArray[np.int32]]:
    """Assign each ball to the narrowest group that has room for its points.

    Args:
        indices: (Q, samples), what `ball_query` found.
        count: N, of the points.
    """
    samples = indices.shape[1]
    widths = group_widths(samples)
    # The first point, and what repeats it. Other sums along so short an axis take three times as long, and a matrix
    # product wakes BLAS threads (`geometry.frame_change`).
    first = np.einsum("ij->i", (indices == indices[:, :1]).astype(np.float32))
    group = np.searchsorted(np.array(widths, np.float32), samples + 1 - first).astype(np.uint8)
    order = np.argsort(group, kind="stable").astype(np.int32)
    rows = np.empty_like(order)
    rows[order] = np.arange(len(order), dtype=np.int32)
    ends = np.cumsum(np.bincount(group, minlength=len(widths)))[:-1]
    balls = np.take(indices, order, axis=0)
    queries = np.where(balls[:, 0] < count, order, np.int32(len(order)))
    groups = zip(np.split(queries, ends), np.split(balls, ends), widths, strict=True)
    return GroupedBalls(
        tuple(
            BallGroup(centers_of_group, np.ascontiguousarray(ball[:, :width]))
            for centers_of_group, ball, width in groups
        ),
        rows,
    )


def gather_balls(
    points: NDArray[np.float32], centers: NDArray[np.float32], indices: NDArray[np.int32]
) -> NDArray[np.float32]:
    """Gather the points of each ball, their positions relative to its center; zeros for empty entries.

    Args:
        points: (N, 3 + C), x, y, z first.
        centers: (Q, 3) in the same frame.
        indices: (Q, T) from `ball_query`.

    Returns:
        (Q, T, 3 + C).
    """
    if not len(points):
        return np.zeros((*indices.shape, points.shape[1]), np.float32)
    balls = np.take(points, indices, axis=0, mode="clip")
    # Row by row: NumPy is slow along an axis as short as the coordinates'.
    away = np.zeros((len(centers), points.shape[1]), np.float32)
    away[:, :3] = centers
    balls -= np.tile(away, (1, indices.shape[1])).reshape(balls.shape)
    balls[indices[:, 0] == len(points)] = 0
    return balls
