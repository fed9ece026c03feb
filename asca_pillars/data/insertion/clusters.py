"""What stands on the ground: clusters and the rectangles around them (section 3.5, steps 3 and 4)."""

import cv2
import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.insertion.ground_fit import Ground

CLUSTER_MIN_POINTS = 3
_CELL_M = 0.25
_REACH_CELLS = 2
_TILE_M = 5.0
_TILES = 1000  # more than lie side by side


def cluster_boxes(obstacles: NDArray[np.float64], ground: Ground) -> NDArray[np.float32]:
    """Steps 3 and 4: DBSCAN of obstacle points (N, 3), and the minimum-area rectangle of each cluster as a box (K, 7).

    Points and boxes are in metres and radians, LiDAR frame.

    A cluster larger than any vehicle is a row of houses, hedges and parked cars; its rectangle would take the street
    along with it, so it is cut into tiles, and each piece gets its own rectangle.
    """
    labels = cluster_labels(obstacles[:, :2])
    clustered = labels > 0  # lone points stay out here; their cells are blocked too
    pieces = _tiled(obstacles[clustered], labels[clustered])
    rectangles = [cv2.minAreaRect(piece[:, :2].astype(np.float32)) for piece in pieces]
    boxes = np.array([(*middle, 0, *sides, 0, np.radians(angle)) for middle, sides, angle in rectangles])
    boxes = boxes.reshape(-1, 7)
    top = np.array([piece[:, 2].max() for piece in pieces])
    bottom = ground.heights(boxes[:, :2])
    boxes[:, 5] = np.maximum(top - bottom, 0.1)
    boxes[:, 2] = bottom + boxes[:, 5] / 2
    return boxes.astype(np.float32)


def cluster_labels(xy_m: NDArray[np.float64]) -> NDArray[np.int64]:
    """DBSCAN of points (N, 2), metres: the number (N,) of each point's cluster from 1 on, 0 for a point in none.

    Clustered are the cells in which points lie, weighted by their number; neighbors are those up to _REACH_CELLS away
    in x and in y. So it is done on a raster, in a fraction of the time that lists of neighbors take.
    """
    if not len(xy_m):
        return np.zeros(0, np.int64)
    index = np.floor(xy_m / _CELL_M).astype(np.int64)
    index -= index.min(axis=0)
    shape = index.max(axis=0) + 1
    cells = index[:, 0] * shape[1] + index[:, 1]
    count = np.bincount(cells, minlength=shape.prod()).reshape(shape).astype(np.float32)
    around = (2 * _REACH_CELLS + 1, 2 * _REACH_CELLS + 1)
    near = cv2.boxFilter(count, -1, around, normalize=False, borderType=cv2.BORDER_CONSTANT)
    core = (count > 0) & (near >= CLUSTER_MIN_POINTS)
    # Widened by one less than the reach, towards lower indices, neighbors touch and others do not.
    touching = cv2.dilate(core.astype(np.uint8), np.ones((_REACH_CELLS, _REACH_CELLS), np.uint8))
    _, labels = cv2.connectedComponents(touching, connectivity=8)
    # What has a core point near belongs to its cluster.
    labels = cv2.dilate(np.where(core, labels, 0).astype(np.float32), np.ones(around, np.uint8))
    return labels.ravel()[cells].astype(np.int64)


def _tiled(points: NDArray[np.float64], labels: NDArray[np.int64]) -> list[NDArray[np.float64]]:
    """The points of each cluster, cut into squares of _TILE_M if it is longer than two of them."""
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
