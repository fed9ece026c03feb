"""What stands on the ground: clusters and the rectangles around them (section 3.5, steps 3 and 4)."""

import cv2
import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.insertion.ground_fit import Ground

CLUSTER_EPS_M = 0.6
CLUSTER_MIN_POINTS = 3
_CELL_M = 0.25
_TILE_M = 5.0


def cluster_boxes(obstacles: NDArray[np.float64], ground: Ground) -> NDArray[np.float32]:
    """Steps 3 and 4: DBSCAN of obstacle points (N, 3), and the minimum-area rectangle of each cluster as a box (K, 7).

    Points and boxes are in metres and radians, LiDAR frame.

    Clustered are the cells in which points lie, weighted by their number: some thousand instead of ten thousands. A
    cluster larger than any vehicle is a row of houses, hedges and parked cars; its rectangle would take the street
    along with it, so it is cut into tiles, and each piece gets its own rectangle.
    """
    from sklearn.cluster import DBSCAN

    if not len(obstacles):
        return np.zeros((0, 7), np.float32)
    index, inverse, count = np.unique(
        np.floor(obstacles[:, :2] / _CELL_M).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    middles = (index + 0.5) * _CELL_M
    labels = DBSCAN(eps=CLUSTER_EPS_M, min_samples=CLUSTER_MIN_POINTS).fit(middles, sample_weight=count).labels_
    labels = labels[inverse.ravel()]
    clustered = labels >= 0  # lone points stay out here; their cells are blocked too
    obstacles, labels = obstacles[clustered], labels[clustered]
    order = np.argsort(labels, kind="stable")
    obstacles, labels = obstacles[order], labels[order]
    clusters = np.split(obstacles, np.flatnonzero(np.diff(labels)) + 1)
    pieces = [piece for cluster in clusters if len(cluster) for piece in _tiles(cluster)]
    boxes = np.zeros((len(pieces), 7), np.float32)
    for row, piece in zip(boxes, pieces, strict=True):
        (x, y), (length, width), angle_deg = cv2.minAreaRect(piece[:, :2].astype(np.float32))
        bottom = float(ground.heights(np.array([[x, y]]))[0])
        height = max(float(piece[:, 2].max()) - bottom, 0.1)
        row[:] = (x, y, bottom + height / 2, length, width, height, np.radians(angle_deg))
    return boxes


def _tiles(cluster: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The points of a cluster, cut into squares of _TILE_M if it is longer than two of them."""
    if np.ptp(cluster[:, :2], axis=0).max() <= 2 * _TILE_M:
        return [cluster]
    _, tile = np.unique(np.floor(cluster[:, :2] / _TILE_M), axis=0, return_inverse=True)
    tile = tile.ravel()
    return [cluster[tile == number] for number in range(tile.max() + 1)]
