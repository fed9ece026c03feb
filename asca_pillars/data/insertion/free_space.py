"""Free space for objects in a scan: visible ground minus the obstacles on it (section 3.5, steps 2 to 4).

Visible ground: along one azimuth the beams of a spinning LiDAR hit the ground ring by ring. Between two neighboring
hits the beam to the farther one passed low over the ground, so nothing tall is there, although a gap of metres
separates the returns. A gap too long for this, an obstacle in it, a step or a slope ends the free
ground. Ground behind an obstacle is not visible and therefore not free, nor is anything outside the camera's view.
"""

import math
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path
from zipfile import BadZipFile

import cv2
import numpy as np

from asca_pillars.base.processes import map_in_processes
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.data.frames import LabeledSplit
from asca_pillars.data.insertion.ground_fit import (
    GROUND_BAND_M,
    LATTICE_M,
    REACH_M,
    Ground,
    cluster_boxes,
    fit_ground,
    order_by_cell,
)
from asca_pillars.data.insertion.prepared import require_writable, writable_atomic_path
from asca_pillars.geometry.boxes import Floating, Floats, Ints, Mask, Singles, footprints
from asca_pillars.scans.ground_height import plane_heights

CELL_M = 0.25
OBSTACLE_M = (0.25, 2.5)  # heights above the ground of obstacles to a person or a car
CLEARANCE_M = 0.3  # largest height above the ground of a beam that shows it to be free
MAX_SLOPE = 0.06
_AZIMUTH_RAD = np.radians(0.4)
_AZIMUTHS = 900
_RINGS = math.ceil(math.sqrt(2) * REACH_M / CELL_M) + 1
CELLS_PER_NODE = round(LATTICE_M / CELL_M)


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """Free ground of one frame, LiDAR frame, metres.

    Attributes:
        ground: the fitted surface; None if no ground is visible, and nothing is free then.
        free: (X, Y) bool, cells of CELL_M from `ground.origin_m` on.
        clusters: (K, 7) float32 minimum-area rectangles around the clusters, as boxes on the ground.
    """

    ground: Ground | None
    free: Mask
    clusters: Singles

    @cached_property
    def cells(self) -> tuple[Floats, Floats]:
        """Centers (2, F) of the free cells, x and y, and their distances (F,) from the sensor, metres, LiDAR frame."""
        if self.ground is None:
            return np.zeros((2, 0)), np.zeros(0)
        xy = self.ground.origin_m[:, None] + (np.array(np.nonzero(self.free)) + 0.5) * CELL_M
        return xy, np.hypot(xy[0], xy[1])

    def is_free(self, xy_m: Floating) -> Mask:
        """Return whether the cells at (..., 2) are free: (...) bool."""
        if self.ground is None:
            return np.zeros(xy_m.shape[:-1], bool)
        index = np.floor((xy_m - self.ground.origin_m) / CELL_M).astype(np.int64)
        row, column = index[..., 0], index[..., 1]
        rows, columns = self.free.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        return np.asarray(inside & self.free.ravel().take(row * columns + column, mode="clip"))


def find_free_space(points: Floating) -> FreeSpace:
    """Compute the free space (steps 2 to 4) of the points (N, >=3) of one scan, metres, LiDAR frame."""
    nothing = FreeSpace(None, np.zeros((0, 0), bool), np.zeros((0, 7), np.float32))
    ground = fit_ground(points)
    if ground is None:
        return nothing
    low = ground.origin_m[:, None]
    high = low + np.array(ground.rise_m.shape)[:, None] * LATTICE_M
    xyz = np.ascontiguousarray(points[:, :3].T, np.float64)
    xyz = np.compress(((xyz[:2] >= low) & (xyz[:2] < high)).all(axis=0), xyz, axis=1)
    above = xyz[2] - ground.heights(xyz[:2].T)
    on_ground = np.abs(above) < GROUND_BAND_M
    obstacle = (above > OBSTACLE_M[0]) & (above < OBSTACLE_M[1])
    standing = np.compress(obstacle, xyz, axis=1)
    clusters = cluster_boxes(standing.T, ground)
    free = _seen_ground(xyz[:2], on_ground, obstacle, ground) & _is_flat(ground)
    blocked = np.zeros(free.shape, np.uint8)
    rows, columns = ((standing[:2] - low) / CELL_M).astype(np.int64)
    blocked[rows, columns] = 1
    # OpenCV's x is the second index, and integers are the middles of cells.
    corners = ((footprints(clusters.astype(np.float64)) - ground.origin_m) / CELL_M - 0.5)[..., ::-1]
    for outline in np.round(corners * 16).astype(np.int32):
        cv2.fillConvexPoly(blocked, outline, 1, shift=4)
    return FreeSpace(ground, free & (blocked == 0), clusters)


def _seen_ground(xy_m: Floats, on_ground: Mask, obstacle: Mask, ground: Ground) -> Mask:
    """Return cells (X, Y) of ground that beams hit or passed low over, for points (2, N); see the module docstring."""
    used = on_ground | obstacle
    (x, y), on_ground = np.compress(used, xy_m, axis=1), on_ground[used]
    distance = np.hypot(x, y)
    azimuth = _azimuth_bin(x, y)
    order = order_by_cell(azimuth, distance)
    distance, azimuth, on_ground = distance[order], azimuth[order], on_ground[order]
    sensor_m = max(-float(ground.heights(np.zeros((1, 2)))[0]), 0.5)
    gap = np.diff(distance)
    joined = (np.diff(azimuth) == 0) & on_ground[1:] & on_ground[:-1]
    joined &= gap < np.maximum(CLEARANCE_M / sensor_m * distance[1:], 2 * CELL_M)
    cell = azimuth * _RINGS + (distance / CELL_M).astype(np.int64)
    polar = np.zeros((_AZIMUTHS, _RINGS), bool)
    polar.flat[cell[on_ground]] = True
    start, length = cell[:-1][joined], np.diff(cell)[joined]
    between = np.arange(length.sum()) + np.repeat(start - np.cumsum(length) + length, length)
    polar.flat[between] = True
    # Some firings have no return: one azimuth without returns between two with is not a gap in the ground.
    polar |= np.roll(polar, 1, axis=0) & np.roll(polar, -1, axis=0)

    row, column = np.round((ground.origin_m + REACH_M) / CELL_M).astype(int)
    rows, columns = np.array(ground.rise_m.shape) * CELLS_PER_NODE
    return polar.ravel()[_polar_index()[row : row + rows, column : column + columns]]


@cache
def _polar_index() -> Ints:
    """Return the index of azimuth and ring of each cell (X, Y) of the square of half size REACH_M."""
    middles = np.arange(-REACH_M, REACH_M, CELL_M) + 0.5 * CELL_M
    x, y = np.meshgrid(middles, middles, indexing="ij")
    return _azimuth_bin(x, y) * _RINGS + (np.hypot(x, y) / CELL_M).astype(np.int64)


def _is_flat(ground: Ground) -> Mask:
    """Return cells (X, Y) where the ground's slope is plausible for a street."""
    nodes = _nodes(ground)
    heights = plane_heights(ground.plane, nodes) + ground.rise_m.astype(np.float64)
    slopes = np.gradient(heights, LATTICE_M)
    flat = np.hypot(*slopes) < MAX_SLOPE
    return np.repeat(np.repeat(flat, CELLS_PER_NODE, axis=0), CELLS_PER_NODE, axis=1)


def _azimuth_bin(x_m: Floats, y_m: Floats) -> Ints:
    return np.floor(np.arctan2(y_m, x_m) / _AZIMUTH_RAD).astype(np.int64) % _AZIMUTHS


def _nodes(ground: Ground) -> Floats:
    """Return the (X, Y, 2) middles of the ground's lattice."""
    rows, columns = np.indices(ground.rise_m.shape)
    return ground.origin_m + (np.stack([rows, columns], axis=-1) + 0.5) * LATTICE_M


VERSION = 2  # of the computation; files of another version are computed again
_AT_ONCE = 16


def prepare_free_spaces(
    split: LabeledSplit, prepared: Path, *, camera_view: bool, workers: int, reporter: Reporter = SILENT
) -> None:
    """Make the files of all frames of a list that are missing or outdated.

    Raises:
        DatasetError: a frame cannot be read, or the folder cannot be written.
    """
    require_writable(prepared)
    job = partial(_prepare, split, prepared, camera_view)
    for _ in map_in_processes(job, split.frame_ids, workers, "Free ground", at_once=_AT_ONCE, reporter=reporter):
        pass


def load_free_space(split: LabeledSplit, frame_id: str, prepared: Path, *, camera_view: bool) -> FreeSpace:
    """Load the free space of a frame, seen from the sensor at its origin (`to_sensor`), from its file in `prepared`.

    It is computed and stored there if missing or outdated.

    Raises:
        DatasetError: the calibration cannot be read, or the folder cannot be written.
        ScanError: the scan cannot be read.
    """
    path = prepared / "free_space" / split.pool / ("camera" if camera_view else "full") / f"{frame_id}.npz"
    stamp = _stamp(split, frame_id)
    if (space := _read(path, stamp)) is not None:
        return space
    points = split.points(frame_id, camera_view=camera_view)
    space = find_free_space(points if split.to_sensor.is_identity else split.to_sensor.points(points))
    _write(path, stamp, space)
    return space


def _stamp(split: LabeledSplit, frame_id: str) -> Ints:
    """Return numbers that change when a file that the map was computed from changes."""
    return np.array([VERSION, *split.points_state(frame_id)])


def _read(path: Path, stamp: Ints) -> FreeSpace | None:
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            if not np.array_equal(file["stamp"], stamp):
                return None
            rise, clusters = file["rise_m"], file["clusters"]
            if not rise.size:
                return FreeSpace(None, np.zeros((0, 0), bool), clusters)
            shape = np.array(rise.shape) * CELLS_PER_NODE
            free = np.unpackbits(file["free"], count=shape.prod()).astype(bool).reshape(shape)
            return FreeSpace(Ground(file["plane"], file["origin_m"], rise), free, clusters)
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):  # missing or damaged: it is computed again
        return None


def _write(path: Path, stamp: Ints, space: FreeSpace) -> None:
    ground = space.ground or Ground(np.zeros(3), np.zeros(2), np.zeros((0, 0), np.float16))
    with writable_atomic_path(path) as temporary:
        np.savez(
            temporary,
            stamp=stamp,
            plane=ground.plane,
            origin_m=ground.origin_m,
            rise_m=ground.rise_m,
            free=np.packbits(space.free),
            clusters=space.clusters,
        )


def _prepare(split: LabeledSplit, prepared: Path, camera_view: bool, frame_id: str) -> None:
    load_free_space(split, frame_id, prepared, camera_view=camera_view)
