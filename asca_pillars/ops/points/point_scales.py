"""Raw points at several scales around keypoints: what AFE-RCNN's features of them are computed from (section 3.2)."""

from collections.abc import Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from asca_pillars.ops.points.ball_query import ball_query, three_nearest

_FEWER = 4  # a scale has a quarter of the positions of the one before

Array = TypeVar("Array")


class PointScale(NamedTuple, Generic[Array]):
    """M positions with a group around each: of points on the finest scale, then of positions of the scale before.

    Of one scan (NumPy) or of a batch (tensors).
    """

    positions: Array
    """(M, 3), metres, LiDAR frame."""
    groups: Array
    """(M, samples) what is around each, see `ball_query`."""
    nearest: Array
    """Of each position of the scale before the three nearest of these, (_, 3); of the finest scale (0, 3)."""
    nearest_weights: Array
    """Likewise inverse distances, sum 1."""


def point_scales(
    points: NDArray[np.float32], keypoints: NDArray[np.float32], radii_m: Sequence[float], samples: int
) -> tuple[PointScale[NDArray[Any]], ...]:
    """A scale for each radius, the finest first: all keypoints, the first quarter of them, the first sixteenth.

    Keypoints are farthest points in the order in which they were taken, so that the first of them are what sampling
    the keypoints again would take.

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
