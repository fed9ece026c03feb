"""Layouts of balls that graphs read faster than `ball_query`'s indices: gathered points, or groups of like size.

A row of `ball_query` repeats its first point where the ball holds fewer. The maximum over a ball is the same without
the repetitions; on the grids of proposals most of what the rows hold are repetitions.
"""

from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

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
    # product wakes BLAS threads (`geometry.rotations`).
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
        tuple(BallGroup(own, np.ascontiguousarray(ball[:, :width])) for own, ball, width in groups), rows
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
