"""Ground of a scan: a plane fitted by RANSAC, and the height of the surface above it (section 3.5, step 2).

The paper fits one plane and takes all points near it as ground. A street has camber and kerbs, and over 70 m it
follows hills: one plane deviates by decimetres near and by metres far away, where an inserted object would float or
sink. The plane (the paper's "ground fitting parameters") is kept as the frame of reference, with the mean height of the
returns above it on a lattice of 1 m, filled and smoothed where there are few. Points close to that surface are ground.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.boxes import Floating, Floats, Ints, Singles
from asca_pillars.scans.ground_height import most_common_plane, plane_heights

REACH_M = 80.0  # farther points are ignored
LATTICE_M = 1.0
GROUND_BAND_M = 0.15  # largest distance of ground returns from the surface
_COARSE_M = 2.0
_OPENING_CELLS = 5  # narrower structures above the ground, in coarse cells, are removed
_PLANE_REACH_M = 40.0
_PLANE_BAND_M = 0.15
_MIN_CELLS = 30
_MAX_SLOPE = 0.3
_UNKNOWN = 1e3


@dataclass(frozen=True, eq=False)
class Ground:
    """Ground surface of one scan. LiDAR frame, metres.

    Attributes:
        plane: (3,) float64 a, b, c of z = a x + b y + c.
        origin_m: (2,) float64 x, y of the lattice's corner.
        rise_m: (X, Y) float16 height of the surface above the plane at the middles of the lattice's cells.
    """

    plane: Floats
    origin_m: Floats
    rise_m: NDArray[np.float16]

    def heights(self, xy_m: Floating) -> Floats:
        """Return z (N,) of the ground at (N, 2), interpolated; outside the lattice as at its border."""
        return plane_heights(self.plane, xy_m) + _interpolate(self.rise_m, self.origin_m, LATTICE_M, xy_m)


def fit_plane(points: Floating) -> Floats | None:
    """Fit the ground plane (3,) of points (N, >=3) by RANSAC, or return None if no ground is visible.

    One low point per square metre within 40 m is used: walls and cars, most of the points, become few, and the rings
    near the sensor do not outvote the rest. The samples are seeded: the same points give the same plane.
    """
    x, y, z = np.ascontiguousarray(points[:, :3].T, np.float64)
    within = np.flatnonzero(np.hypot(x, y) < _PLANE_REACH_M)
    cells = np.floor(x[within] / LATTICE_M) * 10_000 + np.floor(y[within] / LATTICE_M)
    low = within[_low_per_cell(cells, z[within])]
    if len(low) < _MIN_CELLS:
        return None
    return most_common_plane(np.stack([x[low], y[low], z[low]], axis=1), _PLANE_BAND_M, _MAX_SLOPE)


def fit_ground(points: Floating) -> Ground | None:
    """Fit the surface under points (N, >=3), metres, LiDAR frame, or return None if no ground is visible."""
    # By columns: selecting many short rows takes ten times as long.
    xyz = np.ascontiguousarray(points[:, :3].T, np.float64)
    xyz = np.compress((np.abs(xyz[:2]) < REACH_M).all(axis=0), xyz, axis=1)
    plane = fit_plane(xyz.T)
    if plane is None:
        return None
    above = xyz[2] - plane_heights(plane, xyz[:2].T)
    # With hills the ground deviates from the plane with distance; points outside this wedge are not ground.
    wedge = np.abs(above) < 0.4 + 0.05 * np.hypot(xyz[0], xyz[1])
    xy, above = np.compress(wedge, xyz[:2], axis=1).T, above[wedge]
    origin = np.floor(xy.min(axis=0) / _COARSE_M) * _COARSE_M
    coarse = _coarse_surface(xy, above, origin)
    ground = np.abs(above - _interpolate(coarse, origin, _COARSE_M, xy)) < 0.25
    shape = np.array(coarse.shape) * round(_COARSE_M / LATTICE_M)
    cells = _flat_cells(np.compress(ground, xy.T, axis=1).T, origin, LATTICE_M, shape)
    counts = np.bincount(cells, minlength=shape.prod())
    sums = np.bincount(cells, above[ground], minlength=shape.prod())
    means = sums / np.maximum(counts, 1)
    weights = np.minimum(counts, 5.0)
    rise = _smooth(means.reshape(shape), weights.reshape(shape), sigmas=(0.7, 1.5, 4, 12))
    return Ground(plane, origin, rise.astype(np.float16))


def _coarse_surface(xy_m: Floating, above_m: Floating, origin_m: Floating) -> Singles:
    """Return heights above the plane on the coarse lattice, without objects on the ground.

    The low points of the cells follow the ground except under cars and behind walls. A morphological opening removes
    these: structures that are narrower than its window. Slopes are kept.
    """
    shape = ((xy_m - origin_m).max(axis=0) / _COARSE_M).astype(np.int64) + 1
    cells = _flat_cells(xy_m, origin_m, _COARSE_M, shape)
    low = _low_per_cell(cells, above_m)
    lowest = np.full(shape, _UNKNOWN, np.float32)
    lowest.flat[cells[low]] = above_m[low]
    window = np.ones((_OPENING_CELLS, _OPENING_CELLS), np.uint8)
    eroded = cv2.erode(lowest, window)
    opened = cv2.dilate(np.where(eroded < _UNKNOWN, eroded, -_UNKNOWN), window)
    ground = (lowest - opened < 0.2).astype(np.float32)
    return _smooth(np.where(ground > 0, lowest, 0), ground, sigmas=(0.7, 2, 6, 20))


def _flat_cells(xy_m: Floating, origin_m: Floating, step_m: float, shape: Ints) -> Ints:
    """Return the index (N,), in a raster (X, Y) in row-major order, of the cell of each of (N, 2)."""
    index = ((xy_m - origin_m) / step_m).astype(np.int64)
    return np.asarray(index[:, 0] * shape[1] + index[:, 1])


def order_by_cell(cells: NDArray[Any], values_m: Floating) -> Ints:
    """Return the order (N,) of points by the number of their cell and, within a cell, by a value, metres."""
    # Sorted by one combined number: a sixth of the time of sorting by two.
    return np.argsort(cells * (4 * _UNKNOWN) + np.clip(values_m, -_UNKNOWN, _UNKNOWN))


def _low_per_cell(cells: NDArray[Any], heights_m: Floating) -> Ints:
    """Return the index of the point at the tenth percentile of height in each occupied cell."""
    order = order_by_cell(cells, heights_m)
    first = np.flatnonzero(np.diff(cells[order], prepend=np.nan))
    count = np.diff(first, append=len(cells))
    return np.asarray(order[first + count // 10])


def _smooth(values: Floating, weights: Floating, sigmas: tuple[float, ...]) -> Singles:
    """Return a weighted Gaussian mean; where the narrowest kernel has no weight, that of the next wider one."""
    values, weights = values.astype(np.float32), weights.astype(np.float32)
    result = np.zeros_like(values)
    missing = np.ones(values.shape, bool)
    for sigma in sigmas:
        total = cv2.GaussianBlur(weights, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
        filled = missing & (total > 0.02)
        mean = cv2.GaussianBlur(values * weights, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
        result[filled] = mean[filled] / total[filled]
        missing &= ~filled
    return result


def _interpolate(lattice: NDArray[Any], origin_m: Floating, step_m: float, xy_m: Floating) -> Floats:
    """Return bilinear values (N,) at (N, 2) of a lattice of cell middles."""
    rows, columns = lattice.shape
    xy = np.ascontiguousarray(xy_m.T)
    place = np.clip((xy - origin_m[:, None]) / step_m - 0.5, 0, [[rows - 1], [columns - 1]])
    (i, j), (s, t) = place.astype(np.int64), place % 1
    values = (lattice if len(xy_m) < lattice.size else lattice.astype(np.float64)).ravel()
    corner, below, right = i * columns + j, np.where(i < rows - 1, columns, 0), np.where(j < columns - 1, 1, 0)
    near = values[corner] * (1 - t) + values[corner + right] * t
    far = values[corner + below] * (1 - t) + values[corner + below + right] * t
    return np.asarray(near * (1 - s) + far * s)


CLUSTER_MIN_POINTS = 3
_CELL_M = 0.25
_REACH_CELLS = 2
_TILE_M = 5.0
_TILES = 1000  # more than any extent has


def cluster_boxes(obstacles: Floats, ground: Ground) -> Singles:
    """Cluster obstacle points (N, 3) by DBSCAN, and return each cluster's minimum-area rectangle as a box (K, 7).

    Steps 3 and 4 of section 3.5. Points and boxes are in metres and radians, LiDAR frame.

    A cluster larger than any vehicle is a row of houses, hedges and parked cars; its rectangle would include the
    street, so it is cut into tiles, and each tile gets its own rectangle.
    """
    labels = cluster_labels(obstacles[:, :2])
    clustered = labels > 0  # noise points are left out; their cells are blocked too
    pieces = _tiled(obstacles[clustered], labels[clustered])
    rectangles = [cv2.minAreaRect(piece[:, :2].astype(np.float32)) for piece in pieces]
    boxes = np.array([(*middle, 0, *sides, 0, np.radians(angle)) for middle, sides, angle in rectangles])
    boxes = boxes.reshape(-1, 7)
    top = np.array([piece[:, 2].max() for piece in pieces])
    bottom = ground.heights(boxes[:, :2])
    boxes[:, 5] = np.maximum(top - bottom, 0.1)
    boxes[:, 2] = bottom + boxes[:, 5] / 2
    return boxes.astype(np.float32)


def cluster_labels(xy_m: Floats) -> Ints:
    """Cluster points (N, 2), metres, by DBSCAN: number (N,) of each point's cluster from 1 on, 0 for noise.

    The occupied cells are clustered, weighted by their number of points; neighbors are those up to _REACH_CELLS away
    in x and in y. On a raster this takes a fraction of the time of neighbor lists.
    """
    if not len(xy_m):
        return np.zeros(0, np.int64)
    index = np.floor(xy_m / _CELL_M).astype(np.int64)
    index -= index.min(axis=0)
    shape = index.max(axis=0) + 1
    cells = index[:, 0] * shape[1] + index[:, 1]
    count = np.bincount(cells, minlength=shape.prod()).reshape(shape).astype(np.float32)
    around = (2 * _REACH_CELLS + 1, 2 * _REACH_CELLS + 1)
    neighbors = cv2.boxFilter(count, -1, around, normalize=False, borderType=cv2.BORDER_CONSTANT)
    core = (count > 0) & (neighbors >= CLUSTER_MIN_POINTS)
    # Dilated by one less than the reach, towards lower indices, neighbors touch and others do not.
    touching = cv2.dilate(core.astype(np.uint8), np.ones((_REACH_CELLS, _REACH_CELLS), np.uint8))
    _, labels = cv2.connectedComponents(touching, connectivity=8)
    # Points near a core point belong to its cluster.
    labels = cv2.dilate(np.where(core, labels, 0).astype(np.float32), np.ones(around, np.uint8))
    return labels.ravel()[cells].astype(np.int64)


def _tiled(points: Floats, labels: Ints) -> list[Floats]:
    """Return the points of each cluster, cut into squares of _TILE_M if it is longer than two of them."""
    if not len(points):
        return []
    order = np.argsort(labels, kind="stable")
    points, labels = points[order], labels[order]
    first = np.flatnonzero(np.diff(labels, prepend=0))
    length = np.maximum.reduceat(points[:, :2], first) - np.minimum.reduceat(points[:, :2], first)
    long = np.repeat(length.max(axis=1) > 2 * _TILE_M, np.diff(first, append=len(points)))
    tile = np.floor(points[:, :2] / _TILE_M).astype(np.int64) @ (_TILES, 1)
    piece = labels * _TILES**2 + np.where(long, tile, 0)
    order = np.argsort(piece, kind="stable")
    return np.split(points[order], np.flatnonzero(np.diff(piece[order])) + 1)
