"""A simulated folder beside a labelled real one, object by object and cluster by cluster."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from asca_pillars.base.errors import DatasetError
from asca_pillars.data.kitti import Calibration, KittiSplit, boxes_from_objects, in_image
from asca_pillars.detection.detections import Detections
from asca_pillars.scans.scan_reader import read_scan
from asca_pillars.sim.report.look_alikes import NEIGHBORS, LikeRow, compare_objects
from asca_pillars.sim.report.object_records import ObjectRecord, record_objects, seen_objects
from asca_pillars.sim.report.reference import CLASSES
from asca_pillars.sim.report.unlabelled_clusters import Cluster, FiringRow, find_clusters, firing_rows

Detect = Callable[[NDArray[np.float32]], Detections]
MAX_FRAMES = 400
MIN_SCORE = 0.02
"""Lowest score that a detector should report for the comparison; what is found with less counts as 0."""


@dataclass(frozen=True)
class Side:
    """What was measured in the frames of one folder."""

    source: str
    frames: int
    records: list[ObjectRecord]
    clusters: list[Cluster] | None  # None without a detector


@dataclass(frozen=True)
class LikeForLike:
    """Both sides, and the rows that compare them; firing rates are None without a detector."""

    real: Side
    simulated: Side
    rows: list[LikeRow]
    firing: tuple[list[FiringRow], list[FiringRow]] | None
    detector: str | None

    def to_json(self) -> dict[str, Any]:
        """All numbers; what is not one (a share of no clusters) is null."""
        firing = None
        if self.firing is not None:
            names = ("real", "simulated")
            firing = {name: [asdict(row) for row in rows] for name, rows in zip(names, self.firing, strict=True)}
        sides = {
            name: {"source": side.source, "frames": side.frames, "objects": len(side.records)}
            for name, side in (("real", self.real), ("simulated", self.simulated))
        }
        rows = [asdict(row) for row in self.rows]
        return {**sides, "detector": self.detector, "rows": _finite(rows), "firing": _finite(firing)}


def measure_side(root: str | Path, detect: Detect | None, title: str) -> Side:
    """Measure the frames of `root`/training, at most MAX_FRAMES, evenly spaced; of each what the camera sees.

    Raises:
        DatasetError: there is no scan, or a frame without labels or calibration.
        ScanError: a damaged scan.
    """
    split = KittiSplit(root)
    ids = split.frame_ids
    chosen = np.linspace(0, len(ids) - 1, min(MAX_FRAMES, len(ids))).round().astype(int)
    records: list[ObjectRecord] = []
    clusters: list[Cluster] = []
    for index in track(chosen, title):
        calibration = split.calibration(ids[index])
        points = read_scan(split.scan_path(ids[index])).points
        points = points[in_image(points, calibration, split.image_size_wh(ids[index]))]
        everything = split.objects(ids[index])
        objects = seen_objects(everything)
        boxes = boxes_from_objects(objects, calibration)
        found = None if detect is None else detect(points)
        records += record_objects(points, objects, boxes, found)
        if found is not None:
            ignored = _in_areas(points, [o.bbox for o in everything if o.type == "DontCare"], calibration)
            clusters += find_clusters(points, ignored, boxes, found)
    return Side(str(root), len(chosen), records, None if detect is None else clusters)


def compare_like_for_like(
    real_root: str | Path, simulated_root: str | Path, detect: Detect | None = None, detector: str | None = None
) -> LikeForLike:
    """Measure both folders and compare them.

    Args:
        real_root: labelled frames in KITTI's layout.
        simulated_root: simulated ones.
        detect: points of a scan -> detections from MIN_SCORE on; without it no scores and no firing rates.
        detector: its name.

    Raises:
        DatasetError: a folder cannot be read, or no class has a real object and enough simulated ones.
    """
    real = measure_side(real_root, detect, "Real frames")
    simulated = measure_side(simulated_root, detect, "Simulated frames")
    rows = compare_objects(real.records, simulated.records)
    if not rows:
        raise DatasetError(
            f"{simulated_root}: no class has an object in {real_root} and {NEIGHBORS} here ({_counts(real.records)} "
            f"real; {_counts(simulated.records)} simulated); simulate more frames"
        )
    firing = None
    if real.clusters is not None and simulated.clusters is not None:
        firing = firing_rows(real.clusters, real.frames), firing_rows(simulated.clusters, simulated.frames)
    return LikeForLike(real, simulated, rows, firing, detector)


def _in_areas(
    points: NDArray[np.float32], areas: Sequence[tuple[float, float, float, float]], calibration: Calibration
) -> NDArray[np.bool_]:
    """Which points (N, 4), all of them in the image, lie in one of the areas x1, y1, x2, y2 of it."""
    u, v = calibration.project(points)[0].T
    inside = np.zeros(len(points), bool)
    for x1, y1, x2, y2 in areas:
        inside |= (u >= x1) & (u <= x2) & (v >= y1) & (v <= y2)
    return inside


def _counts(records: Sequence[ObjectRecord]) -> str:
    return ", ".join(f"{name} {sum(record.class_name == name for record in records)}" for name in CLASSES)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
