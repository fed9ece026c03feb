"""Which returns are ground: the method that the reference statistics were made with, for the comparison alone.

A plane through the near ground, then a polar grid in which the local height is tracked outward from it. Cruder than
`data.insertion.ground_fit`, which training uses; but shares of ground can only be compared if both sides call the same
things ground.
"""

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

BAND_M = 0.15  # ground lies within this of the local height
_PLANE_REACH_M = 20.0
_SECTORS = 72  # of 5 degrees
_STEP_M = 2.0
_REACH_M = 80.0
_SEARCH_M = 0.3  # from one cell to the next the local height is looked for this far from the one before
_MIN_POINTS = 3  # fewer in a cell say nothing about its height
_MAX_SLOPE = 0.15
_TRIALS = 150
_SAMPLE = 2000

_Floats = NDArray[np.floating[Any]]


def ground_mask(points: _Floats) -> NDArray[np.bool_]:
    """Which points (N, >=3), LiDAR frame in metres, are ground: (N,) bool, all false where no plane is to be seen."""
    x, y, z = points[:, :3].astype(np.float32).T
    radius = np.hypot(x, y)
    plane = most_common_ground(points[radius < _PLANE_REACH_M])
    if plane is None:
        return np.zeros(len(points), bool)
    above = z - (plane[0] * x + plane[1] * y + plane[2])
    sector = np.minimum(((np.arctan2(y, x) + np.pi) * (_SECTORS / (2 * np.pi))).astype(np.int16), _SECTORS - 1)
    step = np.minimum(radius / _STEP_M, _REACH_M / _STEP_M - 1).astype(np.int16)
    # Cells in the order in which the heights are tracked; small integers are sorted by radix.
    order = np.argsort(step * _SECTORS + sector, kind="stable")
    starts = np.searchsorted(step[order], np.arange(int(_REACH_M / _STEP_M) + 1))
    above, sector = above[order], sector[order]
    ground = np.zeros(len(points), bool)
    height = np.zeros(_SECTORS)
    for first, last in pairwise(starts):
        cell, dz = sector[first:last], above[first:last]
        height = _track(height, cell, dz)
        ground[order[first:last]] = np.abs(dz - height[cell]) < BAND_M
    return ground


def most_common_ground(points: _Floats) -> NDArray[np.float64] | None:
    """RANSAC plane (3,) a, b, c of z = a x + b y + c, metres, through points (N, >=3); None if no draw is level enough.

    The draws are seeded: the same points give the same plane.
    """
    if len(points) < _SECTORS:
        return None
    rng = np.random.default_rng(0)
    sample = points[rng.integers(len(points), size=min(_SAMPLE, len(points))), :3].astype(np.float64)
    corners = sample[rng.integers(len(sample), size=(_TRIALS, 3))]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal[:, 2] = np.where(np.abs(normal[:, 2]) < 1e-6, np.nan, normal[:, 2])
    slope = -normal[:, :2] / normal[:, 2:]
    planes = np.column_stack([slope, corners[:, 0, 2] - (slope * corners[:, 0, :2]).sum(axis=1)])
    planes = planes[np.abs(slope).max(axis=1) < _MAX_SLOPE]
    if len(planes) == 0:
        return None
    lifted = np.column_stack([sample[:, :2], np.ones(len(sample))])
    near = np.abs(sample[:, 2:] - lifted @ planes.T) < BAND_M
    inliers = near[:, near.sum(axis=0).argmax()]
    return np.asarray(np.linalg.lstsq(lifted[inliers], sample[inliers, 2], rcond=None)[0])


def _track(height: NDArray[np.float64], cell: NDArray[np.int16], above: _Floats) -> NDArray[np.float64]:
    """The local heights (S,) of the next ring of cells, from those of the ring before."""
    candidate = np.abs(above - height[cell]) < _SEARCH_M
    count = np.bincount(cell[candidate], minlength=_SECTORS)
    total = np.bincount(cell[candidate], above[candidate], minlength=_SECTORS)
    return np.where(count >= _MIN_POINTS, total / np.maximum(count, 1), height)
