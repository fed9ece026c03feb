"""How often a detector fires at what is not labelled: clusters as large as a person, tall thin ones, bright ones."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.insertion.ground_fit import fit_ground
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.boxes import points_in_boxes

PERSON_HEIGHT_M, THIN_M = (0.9, 2.2), 1.0
BRIGHT_MEAN = 0.45
FIRING_SCORE = 0.4
KINDS = {
    "person": "person-sized (0.9-2.2 m tall, < 1 m wide)",
    "tall": "tall and thin (> 2.2 m tall, < 1 m wide)",
    "bright": "bright ones of these (mean reflectance >= 0.45)",
}
_CELL_M = 0.25
_FOOT_M = 0.2  # lower returns may be ground, and join what stands on it
_MIN_POINTS = 10  # fewer have no shape
_NEAR_M = 0.7  # from a cluster's middle to that of a box that fires at it
_AROUND_LABEL_M = 0.4


@dataclass(frozen=True)
class Cluster:
    """A cluster of returns: middle, height above the ground and the longer side of its footprint in metres."""

    x_m: float
    y_m: float
    height_m: float
    width_m: float
    reflectance: float
    fires: bool

    @property
    def kinds(self) -> tuple[str, ...]:
        """The keys of KINDS that it belongs to."""
        if self.width_m >= THIN_M or self.height_m < PERSON_HEIGHT_M[0]:
            return ()
        size = "person" if self.height_m <= PERSON_HEIGHT_M[1] else "tall"
        return (size, "bright") if self.reflectance >= BRIGHT_MEAN else (size,)


@dataclass(frozen=True)
class FiringRow:
    """Clusters of one kind: how many per frame, and the share of them that fire with its standard error."""

    kind: str
    frames: int
    clusters: int
    share: float
    error: float

    @property
    def per_frame(self) -> float:
        """Clusters of this kind in one frame, on average."""
        return self.clusters / self.frames


def find_clusters(
    points: NDArray[np.float32], ignored: NDArray[np.bool_], labelled: NDArray[np.float32], found: Detections
) -> list[Cluster]:
    """Clusters of at least _MIN_POINTS returns above the ground that touch no labelled box, widened a little.

    Args:
        points: (N, 4), LiDAR frame.
        ignored: (N,) mask of points in DontCare areas, whose objects are not labelled.
        labelled: (M, 7) boxes of everything that has a label, LiDAR frame.
        found: what the detector finds.
    """
    ground = fit_ground(points)
    if ground is None:
        return []
    above = points[:, 2] - ground.heights(points[:, :2].astype(np.float64))
    wide = labelled + np.array([0, 0, 0, 1, 1, 1, 0], np.float32) * 2 * _AROUND_LABEL_M
    standing = (above > _FOOT_M) & ~ignored & ~points_in_boxes(points, wide).any(axis=1)
    body, height = points[standing], above[standing]
    if not len(body):
        return []
    label = connected(body[:, :2])
    order = np.argsort(label, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(label[order])) + 1)
    persons = np.array([name in ("Pedestrian", "Cyclist") for name in found.names], bool)
    firing = found.boxes[persons & (found.scores >= FIRING_SCORE), :2]
    return [_cluster(body[part], height[part], firing) for part in parts if len(part) >= _MIN_POINTS]


def connected(xy_m: NDArray[np.float32]) -> NDArray[np.int64]:
    """Numbers (N,) of the groups of points (N, 2) whose cells of _CELL_M touch."""
    cell = np.floor(xy_m / _CELL_M).astype(np.int64)
    cell -= cell.min(axis=0)
    raster = np.zeros(cell.max(axis=0) + 1, np.uint8)
    raster[cell[:, 0], cell[:, 1]] = 1
    _, groups = cv2.connectedComponents(raster, connectivity=8)
    return np.asarray(groups[cell[:, 0], cell[:, 1]], np.int64)


def firing_rows(clusters: Sequence[Cluster], frames: int) -> list[FiringRow]:
    """A row of each kind."""
    rows = []
    for kind in KINDS:
        fires = np.array([cluster.fires for cluster in clusters if kind in cluster.kinds], bool)
        count = len(fires)
        share = float(fires.mean()) if count else float("nan")
        # Laplace's estimate in the error alone: none of a few is not a share of 0 for certain.
        likely = (fires.sum() + 1) / (count + 2)
        rows.append(FiringRow(kind, frames, count, share, float(np.sqrt(likely * (1 - likely) / max(count, 1)))))
    return rows


def _cluster(points: NDArray[np.float32], height: NDArray[np.float64], firing: NDArray[np.float32]) -> Cluster:
    (x, y), sides, _ = cv2.minAreaRect(np.ascontiguousarray(points[:, :2]))
    near = np.hypot(firing[:, 0] - x, firing[:, 1] - y) < _NEAR_M
    return Cluster(x, y, float(height.max()), max(sides), float(points[:, 3].mean()), bool(near.any()))
