"""The ground under a scan: a plane fitted by RANSAC, and how far the real surface rises above it (section 3.5, step 2).

The paper fits one plane and calls everything near it ground. A street has camber and kerbs, and over 70 m it follows
its hills: one plane misses it by decimetres near and by metres far away, where an inserted object would hover or sink.
The plane (the paper's "ground fitting parameters") is kept as the frame of reference, and on a lattice of 1 m the mean
height of the returns above it, filled and smoothed where there are few. Ground is what lies close to that surface.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

REACH_M = 80.0  # beyond this, nothing is looked at
LATTICE_M = 1.0
GROUND_BAND_M = 0.15  # ground returns lie within this of the surface
_COARSE_M = 2.0
_OPENING_CELLS = 5  # what is narrower than so many coarse cells and stands out is no ground
_PLANE_REACH_M = 40.0
_PLANE_BAND_M = 0.15
_MIN_CELLS = 30
_MAX_SLOPE = 0.3
_UNKNOWN = 1e3

_Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class Ground:
    """The surface under one scan. LiDAR frame, metres.

    Attributes:
        plane: (3,) float64 a, b, c of z = a x + b y + c.
        origin_m: (2,) float64 x, y of the lattice's corner.
        rise_m: (X, Y) float16 height of the surface above the plane at the middles of the lattice's cells.
    """

    plane: NDArray[np.float64]
    origin_m: NDArray[np.float64]
    rise_m: NDArray[np.float16]

    def heights(self, xy_m: _Floats) -> NDArray[np.float64]:
        """z (N,) of the ground at (N, 2), interpolated; beside the lattice as at its border."""
        return plane_heights(self.plane, xy_m) + _interpolate(self.rise_m, self.origin_m, LATTICE_M, xy_m)


def plane_heights(plane: NDArray[np.float64], xy_m: _Floats) -> NDArray[np.float64]:
    """z (N,) of a plane at (N, 2)."""
    return np.asarray(xy_m @ plane[:2] + plane[2], dtype=np.float64)


def fit_plane(points: _Floats) -> NDArray[np.float64] | None:
    """RANSAC plane (3,) through the ground of points (N, >=3), or None where there is none to be seen.

    Fed one low point per square metre within 40 m: walls and cars, most of the points, become few, and the rings near
    the sensor no longer outvote the rest. The draws are seeded: the same points give the same plane.
    """
    # Only frames seen for the first time need it; loaders that find their maps on disk start without.
    from sklearn.linear_model import LinearRegression, RANSACRegressor

    near = points[np.hypot(points[:, 0], points[:, 1]) < _PLANE_REACH_M, :3].astype(np.float64)
    cells = np.floor(near[:, 0] / LATTICE_M).astype(np.int64) * 10_000 + np.floor(near[:, 1] / LATTICE_M).astype(int)
    low = near[_low_per_cell(cells, near[:, 2])[1]]
    if len(low) < _MIN_CELLS:
        return None
    model = RANSACRegressor(
        LinearRegression(),
        residual_threshold=_PLANE_BAND_M,
        is_model_valid=lambda fit, *_: bool(np.abs(fit.coef_).max() < _MAX_SLOPE),
        max_trials=60,
        random_state=0,
    )
    try:
        model.fit(low[:, :2], low[:, 2])
    except ValueError:  # scikit-learn's way to say that no draw was a plane that may be
        return None
    return np.array([*model.estimator_.coef_, model.estimator_.intercept_])


def fit_ground(points: _Floats) -> Ground | None:
    """The surface under points (N, >=3), metres, LiDAR frame, or None where no ground is to be seen."""
    points = points[(np.abs(points[:, :2]) < REACH_M).all(axis=1)]
    plane = fit_plane(points)
    if plane is None:
        return None
    xy = points[:, :2].astype(np.float64)
    above = points[:, 2] - plane_heights(plane, xy)
    # Hills take the ground away from the plane, the farther the more; what lies outside this wedge is none.
    wedge = np.abs(above) < 0.4 + 0.05 * np.hypot(xy[:, 0], xy[:, 1])
    xy, above = xy[wedge], above[wedge]
    origin = np.floor(xy.min(axis=0) / _COARSE_M) * _COARSE_M
    coarse = _coarse_surface(xy, above, origin)
    near = np.abs(above - _interpolate(coarse, origin, _COARSE_M, xy)) < 0.25
    xy, above = xy[near], above[near]
    shape = np.array(coarse.shape) * round(_COARSE_M / LATTICE_M)
    cells = np.ravel_multi_index(tuple(((xy - origin) / LATTICE_M).astype(np.int64).T), tuple(shape))
    counts = np.bincount(cells, minlength=shape.prod())
    sums = np.bincount(cells, above, minlength=shape.prod())
    means = np.divide(sums, counts, out=np.zeros_like(sums), where=counts > 0)
    weights = np.minimum(counts, 5.0)
    rise = _smooth(means.reshape(shape), weights.reshape(shape), sigmas=(0.7, 1.5, 4, 12))
    return Ground(plane, origin, rise.astype(np.float16))


def _coarse_surface(xy_m: _Floats, above_m: _Floats, origin_m: _Floats) -> NDArray[np.float32]:
    """Heights above the plane on the coarse lattice, without what stands on the ground.

    The low points of the cells follow the ground except under cars and behind walls. A morphological opening tells
    these: it cuts off what stands out and is narrower than its window, and keeps slopes.
    """
    index = ((xy_m - origin_m) / _COARSE_M).astype(np.int64)
    shape = tuple(index.max(axis=0) + 1)
    cells, low = _low_per_cell(np.ravel_multi_index(tuple(index.T), shape), above_m)
    lowest = np.full(shape, _UNKNOWN, np.float32)
    lowest.flat[cells] = above_m[low]
    window = np.ones((_OPENING_CELLS, _OPENING_CELLS), np.uint8)
    eroded = cv2.erode(lowest, window)
    opened = cv2.dilate(np.where(eroded < _UNKNOWN, eroded, -_UNKNOWN), window)
    ground = (lowest - opened < 0.2).astype(np.float32)
    return _smooth(np.where(ground > 0, lowest, 0), ground, sigmas=(0.7, 2, 6, 20))


def _low_per_cell(cells: NDArray[np.int64], heights_m: _Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The cells in use, and for each the index of the point below which a tenth of its points lie."""
    order = np.lexsort((heights_m, cells))
    unique, first, count = np.unique(cells[order], return_index=True, return_counts=True)
    return unique, order[first + count // 10]


def _smooth(values: _Floats, weights: _Floats, sigmas: tuple[float, ...]) -> NDArray[np.float32]:
    """Weighted Gaussian mean; where the narrow one finds nothing, the next wider."""
    values, weights = values.astype(np.float32), weights.astype(np.float32)
    result = np.zeros_like(values)
    missing = np.ones(values.shape, bool)
    for sigma in sigmas:
        total = cv2.GaussianBlur(weights, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
        found = missing & (total > 0.02)
        mean = cv2.GaussianBlur(values * weights, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
        result[found] = mean[found] / total[found]
        missing &= ~found
    return result


def _interpolate(lattice: NDArray[Any], origin_m: _Floats, step_m: float, xy_m: _Floats) -> NDArray[np.float64]:
    """Bilinear values (N,) at (N, 2) of a lattice of cell middles."""
    size = np.array(lattice.shape)
    place = np.clip((xy_m - origin_m) / step_m - 0.5, 0, size - 1)
    low = np.minimum(place.astype(np.int64), np.maximum(size - 2, 0))
    high = np.minimum(low + 1, size - 1)
    (i, j), (k, m), (s, t) = low.T, high.T, (place - low).T
    values = lattice if len(xy_m) < lattice.size else lattice.astype(np.float64)
    return np.asarray(
        (values[i, j] * (1 - t) + values[i, m] * t) * (1 - s) + (values[k, j] * (1 - t) + values[k, m] * t) * s
    )
