"""Keypoints: farthest-point sampling (PointNet++, arXiv 1706.02413, section 3.2), exact."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.kernels import load_kernels
from asca_pillars.ops.points.columns import KERNELS, require_points, sort_into_columns

_COLUMN_M = 1.5  # 1 to 3 m take about as long


def farthest_points(points: NDArray[Any], count: int) -> NDArray[np.int32]:
    """Indices of points that lie far from each other, in the order in which they are taken.

    The first point, then again and again the one whose nearest taken point is farthest, by squared distance in
    float32; of equally far ones the earlier. Points are kept in columns, of which only those are looked into that a
    new sample can change.

    Args:
        points: (N, >=3) finite x, y, z in metres; N may be 0.
        count: how many; fewer come out where there are fewer different positions.

    Raises:
        ValueError: another shape, or a coordinate that is not finite.
    """
    xyz = require_points(points)
    if not len(xyz) or count < 1:
        return np.empty(0, np.int32)
    return np.asarray(load_kernels(KERNELS).farthest_points(xyz, count, sort_into_columns(xyz, _COLUMN_M)))


def points_near_boxes(
    points: NDArray[np.float32], boxes: NDArray[np.floating[Any]], margin_m: float
) -> NDArray[np.float32]:
    """The points within `margin_m` of the circles around boxes seen from above: (N, 4), (R, 7) -> (M, 4).

    Keypoints are worth more where proposals are (PV-RCNN++, arXiv 2102.00463, section 4.1).
    """
    points = np.ascontiguousarray(points, np.float32)
    centers = boxes[:, :2].astype(np.float32)
    reach = (np.hypot(boxes[:, 3], boxes[:, 4]) / 2 + margin_m).astype(np.float32)
    return np.asarray(load_kernels(KERNELS).near_circles(points, centers, reach * reach))
