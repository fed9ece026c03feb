"""Where an object may be put into a scan: seen ground minus what stands on it (section 3.5, steps 2 to 4).

Ground that is seen: along one azimuth the beams of a spinning LiDAR land ring after ring. Between two neighboring
landings the beam to the farther one passed low over the ground, so nothing tall stands there, although a gap of metres
separates the returns. A gap longer than that argument carries, an obstacle in it, a step or a slope ends the free
ground. Ground behind an obstacle is not seen and therefore not free, nor is anything beside the camera's view.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.insertion.clusters import cluster_boxes
from asca_pillars.data.insertion.ground_fit import GROUND_BAND_M, LATTICE_M, Ground, fit_ground, plane_heights
from asca_pillars.geometry.boxes import footprints

CELL_M = 0.25
OBSTACLE_M = (0.25, 2.5)  # above the ground: what stands in the way of a person or a car
CLEARANCE_M = 0.3  # height above the ground at which a beam may pass and still prove it free
MAX_SLOPE = 0.06
_AZIMUTH_RAD = np.radians(0.4)
_AZIMUTHS = 900
CELLS_PER_NODE = round(LATTICE_M / CELL_M)

_Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """Free ground of one frame, LiDAR frame, metres.

    Attributes:
        ground: the fitted surface; None where no ground is seen, and nothing is free then.
        free: (X, Y) bool, cells of CELL_M from `ground.origin_m` on.
        clusters: (K, 7) float32 minimum-area rectangles around the clusters, as boxes that stand on the ground.
    """

    ground: Ground | None
    free: NDArray[np.bool_]
    clusters: NDArray[np.float32]

    @cached_property
    def cells(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centers (2, F) of the free cells, x and y, and their distances (F,) from the sensor, metres, LiDAR frame."""
        if self.ground is None:
            return np.zeros((2, 0)), np.zeros(0)
        xy = self.ground.origin_m[:, None] + (np.array(np.nonzero(self.free)) + 0.5) * CELL_M
        return xy, np.hypot(xy[0], xy[1])

    def is_free(self, xy_m: _Floats) -> NDArray[np.bool_]:
        """Whether the cells at (..., 2) are free: (...) bool."""
        if self.ground is None:
            return np.zeros(xy_m.shape[:-1], bool)
        index = np.floor((xy_m - self.ground.origin_m) / CELL_M).astype(np.int64)
        row, column = index[..., 0], index[..., 1]
        rows, columns = self.free.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        return np.asarray(inside & self.free.ravel().take(row * columns + column, mode="clip"))


def find_free_space(points: _Floats) -> FreeSpace:
    """Steps 2 to 4 on the points (N, >=3) of one scan, metres, LiDAR frame."""
    nothing = FreeSpace(None, np.zeros((0, 0), bool), np.zeros((0, 7), np.float32))
    ground = fit_ground(points)
    if ground is None:
        return nothing
    low = ground.origin_m
    high = low + np.array(ground.rise_m.shape) * LATTICE_M
    xyz = points[((points[:, :2] >= low) & (points[:, :2] < high)).all(axis=1), :3].astype(np.float64)
    above = xyz[:, 2] - ground.heights(xyz[:, :2])
    on_ground = np.abs(above) < GROUND_BAND_M
    obstacle = (above > OBSTACLE_M[0]) & (above < OBSTACLE_M[1])
    clusters = cluster_boxes(xyz[obstacle], ground)
    free = _seen_ground(xyz[:, :2], on_ground, obstacle, ground) & _is_flat(ground)
    blocked = np.zeros(free.shape, np.uint8)
    cells = np.floor((xyz[obstacle, :2] - low) / CELL_M).astype(np.int64)
    blocked[cells[:, 0], cells[:, 1]] = 1
    for outline in footprints(clusters.astype(np.float64)):
        # OpenCV's x is the second index, and integers name the middles of cells.
        corners = ((outline - low) / CELL_M - 0.5)[:, ::-1]
        cv2.fillConvexPoly(blocked, np.round(corners * 16).astype(np.int32), 1, shift=4)
    return FreeSpace(ground, free & (blocked == 0), clusters)


def _seen_ground(
    xy_m: NDArray[np.float64], on_ground: NDArray[np.bool_], obstacle: NDArray[np.bool_], ground: Ground
) -> NDArray[np.bool_]:
    """Cells (X, Y) of ground that beams landed on or passed low over, see the top of the module."""
    used = on_ground | obstacle
    xy_m, on_ground = xy_m[used], on_ground[used]
    distance = np.hypot(xy_m[:, 0], xy_m[:, 1])
    azimuth = _azimuth_bin(xy_m)
    order = np.lexsort((distance, azimuth))
    distance, azimuth, on_ground = distance[order], azimuth[order], on_ground[order]
    sensor_m = max(-float(ground.heights(np.zeros((1, 2)))[0]), 0.5)
    gap = np.diff(distance)
    joined = (np.diff(azimuth) == 0) & on_ground[1:] & on_ground[:-1]
    joined &= gap < np.maximum(CLEARANCE_M / sensor_m * distance[1:], 2 * CELL_M)
    start = np.concatenate([distance[:-1][joined], distance[on_ground]])
    end = np.concatenate([distance[1:][joined], distance[on_ground]])
    row = np.concatenate([azimuth[:-1][joined], azimuth[on_ground]])

    rings = int(distance.max(initial=0.0) / CELL_M) + 2
    edges = np.zeros((_AZIMUTHS, rings), np.int32)
    np.add.at(edges, (row, (start / CELL_M).astype(np.int64)), 1)
    np.add.at(edges, (row, (end / CELL_M).astype(np.int64) + 1), -1)
    polar = (np.cumsum(edges, axis=1) > 0).astype(np.uint8)
    # Some firings return nothing: one azimuth without returns between two with is no gap in the ground.
    polar |= np.roll(polar, 1, axis=0) & np.roll(polar, -1, axis=0)

    middles = _middles(ground)
    ring = np.minimum((np.hypot(middles[..., 0], middles[..., 1]) / CELL_M).astype(np.int64), rings - 1)
    return polar[_azimuth_bin(middles), ring] > 0


def _is_flat(ground: Ground) -> NDArray[np.bool_]:
    """Cells (X, Y) where the ground's slope is one that a street may have."""
    nodes = _nodes(ground)
    heights = plane_heights(ground.plane, nodes) + ground.rise_m.astype(np.float64)
    slopes = np.gradient(heights, LATTICE_M)
    flat = np.hypot(*slopes) < MAX_SLOPE
    return np.repeat(np.repeat(flat, CELLS_PER_NODE, axis=0), CELLS_PER_NODE, axis=1)


def _azimuth_bin(xy_m: NDArray[np.float64]) -> NDArray[np.int64]:
    return (np.arctan2(xy_m[..., 1], xy_m[..., 0]) / _AZIMUTH_RAD).astype(np.int64) % _AZIMUTHS


def _nodes(ground: Ground) -> NDArray[np.float64]:
    """(X, Y, 2) middles of the ground's lattice."""
    rows, columns = np.indices(ground.rise_m.shape)
    return ground.origin_m + (np.stack([rows, columns], axis=-1) + 0.5) * LATTICE_M


def _middles(ground: Ground) -> NDArray[np.float64]:
    """(X, Y, 2) middles of the free map's cells."""
    rows, columns = np.indices(tuple(np.array(ground.rise_m.shape) * CELLS_PER_NODE))
    return ground.origin_m + (np.stack([rows, columns], axis=-1) + 0.5) * CELL_M
