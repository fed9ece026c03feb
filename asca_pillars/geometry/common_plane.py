"""RANSAC plane fit, robust to walls, cars and leaves among the points."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

_DRAWS = 200
_REFITS = 3
_MIN_AREA_M2 = 10.0
_MIN_SPREAD = 1e-9  # of points across a line through them, relative, squared


def most_common_plane(
    points: NDArray[np.float64], band_m: float, max_slope: float = math.inf
) -> NDArray[np.float64] | None:
    """Fit the plane (3,) a, b, c of z = a x + b y + c with the most of points (N, 3) within `band_m` of it; metres.

    The samples are seeded: the same points give the same plane.

    Args:
        points: any frame.
        band_m: inlier distance along z.
        max_slope: sampled planes that are steeper along x or y are rejected.

    Returns:
        None where no sampled plane is valid, or the inliers are collinear.
    """
    if not len(points):
        return None
    planes = _through_triples(points[np.random.default_rng(0).integers(0, len(points), (_DRAWS, 3))])
    planes = planes[(np.abs(planes[:, :2]) < max_slope).all(axis=1)]
    if not len(planes):
        return None
    x, y, z = np.ascontiguousarray(points.T)
    heights = planes[:, :1] * x + planes[:, 1:2] * y + planes[:, 2:]
    plane = planes[(np.abs(z - heights) < band_m).sum(axis=1).argmax()]
    for _ in range(_REFITS):
        inliers = np.abs(z - plane_heights(plane, points)) < band_m
        refit = _least_squares(x[inliers], y[inliers], z[inliers])
        if refit is None:
            return None
        plane = refit
    return plane


def plane_heights(plane: NDArray[np.float64], xy_m: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Return z (...,) of a plane (3,) at (..., >=2), metres; no matrix product, see `rotations.transform_points`."""
    a, b, c = plane.tolist()
    return np.asarray(a * xy_m[..., 0].astype(np.float64) + b * xy_m[..., 1].astype(np.float64) + c)


def _through_triples(triples: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the planes (M, 3) through the triples (n, 3, 3) whose triangle is large enough in bird's-eye view."""
    (x, y, z), u, v = triples[:, 0].T, (triples[:, 1] - triples[:, 0]).T, (triples[:, 2] - triples[:, 0]).T
    area = u[0] * v[1] - u[1] * v[0]  # twice the triangle's
    regular = np.abs(area) > _MIN_AREA_M2
    divisor = area[regular]
    a = (u[2] * v[1] - u[1] * v[2])[regular] / divisor
    b = (u[0] * v[2] - u[2] * v[0])[regular] / divisor
    return np.stack([a, b, z[regular] - a * x[regular] - b * y[regular]], axis=1)


def _least_squares(
    x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Fit the plane (3,) with least squared distances along z to points, (n,) each; None if they are collinear."""
    if len(x) < 3:
        return None
    middle = x.mean(), y.mean(), z.mean()
    x, y, z = x - middle[0], y - middle[1], z - middle[2]
    xx, xy, yy, xz, yz = (x * x).sum(), (x * y).sum(), (y * y).sum(), (x * z).sum(), (y * z).sum()
    divisor = xx * yy - xy * xy
    if divisor <= _MIN_SPREAD * xx * yy:
        return None
    a, b = (xz * yy - yz * xy) / divisor, (yz * xx - xz * xy) / divisor
    return np.array([a, b, middle[2] - a * middle[0] - b * middle[1]])
