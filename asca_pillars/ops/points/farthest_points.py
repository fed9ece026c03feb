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
    float32; of equally far ones the earlier. numba's form keeps the points in columns and looks only into those that
    a new sample can change; it takes the same points.

    Args:
        points: (N, >=3) finite x, y, z in metres; N may be 0.
        count: how many; fewer come out where there are fewer different positions.

    Raises:
        ValueError: another shape, or a coordinate that is not finite.
    """
    xyz = require_points(points)
    if not len(xyz) or count < 1:
        return np.empty(0, np.int32)
    kernels = load_kernels(KERNELS)
    if kernels is None:
        return _farthest_points(xyz, count)
    return np.asarray(kernels.farthest_points(xyz, count, sort_into_columns(xyz, _COLUMN_M)))


def points_near_boxes(
    points: NDArray[np.float32], boxes: NDArray[np.floating[Any]], margin_m: float
) -> NDArray[np.float32]:
    """The points within `margin_m` of the circles around boxes seen from above: (N, 4), (R, 7) -> (M, 4).

    Keypoints are worth more where proposals are (PV-RCNN++, arXiv 2102.00463, section 4.1).
    """
    points = np.ascontiguousarray(points, np.float32)
    centers = boxes[:, :2].astype(np.float32)
    reach = (np.hypot(boxes[:, 3], boxes[:, 4]) / 2 + margin_m).astype(np.float32)
    kernels = load_kernels(KERNELS)
    near = _near_circles if kernels is None else kernels.near_circles
    return np.asarray(near(points, centers, reach * reach))


def _near_circles(
    points: NDArray[np.float32], centers: NDArray[np.float32], squared: NDArray[np.float32]
) -> NDArray[np.float32]:
    x, y = (np.ascontiguousarray(points[:, axis]) for axis in range(2))
    near = np.zeros(len(points), bool)
    for (center_x, center_y), limit in zip(centers, squared, strict=True):
        dx, dy = x - center_x, y - center_y
        near |= dx * dx + dy * dy < limit
    return points[near]


def _farthest_points(xyz: NDArray[np.float32], count: int) -> NDArray[np.int32]:
    chosen = [0]
    x, y, z = np.ascontiguousarray(xyz[:, :3].T)
    nearest = np.full(len(xyz), np.inf, np.float32)
    while len(chosen) < count:
        dx, dy, dz = x - x[chosen[-1]], y - y[chosen[-1]], z - z[chosen[-1]]
        np.minimum(nearest, dx * dx + dy * dy + dz * dz, out=nearest)
        farthest = int(nearest.argmax())
        if nearest[farthest] == 0:
            break
        chosen.append(farthest)
    return np.array(chosen, np.int32)
