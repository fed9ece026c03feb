"""Comparison of a simulated folder with a labelled real one at equal distance, view and occlusion, and of clusters."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.data.insertion.ground_fit import fit_ground
from asca_pillars.data.kitti import Calibration, KittiObject, KittiSplit, boxes_from_objects, in_image
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.boxes import points_in_boxes, wrap_angle
from asca_pillars.geometry.overlap import bev_iou
from asca_pillars.scans.scan_reader import read_scan
from asca_pillars.sim.report.reference import CLASSES

BRIGHT = 0.5  # least reflectance of bright returns: plates, lamps, reflectors, pale paint
PILLAR_M = 0.16
LOWEST, WHEELS, MIDDLE = (0.0, 0.12), (0.12, 0.30), (0.50, 0.70)  # zones, as fractions of the box's height
SCORED_IOU = 0.25  # least BEV IoU of an object's detection

_Points = NDArray[np.float32]


class ObjectRecord(NamedTuple):
    """Labelled object and its returns.

    Attributes:
        class_name: one of CLASSES.
        distance_m: horizontal distance from the sensor.
        view_deg: angle 0..90 between the heading and the line of sight; 90 is side-on.
        occluded: KITTI's state, 0..3.
        points: number of returns in the box, at least 1.
        lowest, wheels, middle: fractions of them in the zones LOWEST, WHEELS and MIDDLE of the height.
        length_m: length of the box that they cover.
        bright: fraction of them with a reflectance of BRIGHT or more.
        pillars: number of occupied cells of PILLAR_M.
        score: score of the best detection of its class there; 0 without one, NaN without a detector.
    """

    class_name: str
    distance_m: float
    view_deg: float
    occluded: int
    points: float
    lowest: float
    wheels: float
    middle: float
    length_m: float
    bright: float
    pillars: float
    score: float


def record_objects(
    points: _Points, objects: Sequence[KittiObject], boxes: NDArray[np.float32], detections: Detections | None
) -> list[ObjectRecord]:
    """Return records of the objects of CLASSES that have returns.

    Args:
        points: (N, 4) points of the scan, LiDAR frame.
        objects: M labels with a 3D box.
        boxes: (M, 7) their boxes, LiDAR frame.
        detections: detections in the scan; None without a detector.
    """
    inside = points_in_boxes(points, boxes)
    return [
        _record(item.type, item.occluded, box, points[mask], detections)
        for item, box, mask in zip(objects, boxes.astype(np.float64), inside.T, strict=True)
        if item.type in CLASSES and mask.any()
    ]


def seen_objects(objects: Sequence[KittiObject]) -> list[KittiObject]:
    """Return the objects with a 3D box that are in the image."""
    return [item for item in objects if item.has_box_3d and item.bbox[2] > item.bbox[0]]


def _record(
    name: str, occluded: int, box: NDArray[np.float64], points: _Points, detections: Detections | None
) -> ObjectRecord:
    x, y, z, _, _, height, yaw = box
    aside = abs(float(wrap_angle(yaw - np.arctan2(y, x))))
    up = (points[:, 2] - (z - height / 2)) / height
    along = (points[:, 0] - x) * np.cos(yaw) + (points[:, 1] - y) * np.sin(yaw)
    cells = np.unique(np.floor(points[:, :2] / PILLAR_M).astype(np.int64), axis=0)
    lowest, wheels, middle = (float(np.mean((up >= low) & (up < high))) for low, high in (LOWEST, WHEELS, MIDDLE))
    return ObjectRecord(
        class_name=name,
        distance_m=float(np.hypot(x, y)),
        view_deg=float(np.rad2deg(min(aside, np.pi - aside))),
        occluded=max(occluded, 0),
        points=float(len(points)),
        lowest=lowest,
        wheels=wheels,
        middle=middle,
        length_m=float(np.ptp(along)),
        bright=float(np.mean(points[:, 3] >= BRIGHT)),
        pillars=float(len(cells)),
        score=float("nan") if detections is None else _score(name, box, detections),
    )


def _score(name: str, box: NDArray[np.float64], detections: Detections) -> float:
    of_class = detections[np.array([other == name for other in detections.names], bool)]
    if not len(of_class):
        return 0.0
    overlap = bev_iou(box[None].astype(np.float32), of_class.boxes)[0]
    return float(np.max(of_class.scores * (overlap >= SCORED_IOU), initial=0.0))


NEIGHBORS = 30
DISTANCE_SPAN, VIEW_SPAN_DEG, OCCLUSION_SPAN = 0.15, 15.0, 0.5  # the first is of the logarithm
POINTS_SPAN = 0.25  # of the logarithm
ALL = "All"
MEASURES = {
    "points": "points",
    "pillars": "pillars of 0.16 m",
    "lowest": "points in the lowest 12 %",
    "wheels": "points at 12-30 % of height",
    "middle": "points at 50-70 % of height",
    "length_m": "length covered (m)",
    "bright": "bright returns (>= 0.5)",
    "score": "score",
}
_COUNTS = ("points", "pillars")
_DRAWS = 2000


@dataclass(frozen=True)
class LikeRow:
    """One measure of one class.

    Attributes:
        class_name: or ALL.
        measure: a key of MEASURES.
        objects: number of real objects compared.
        real, simulated: means over the objects, and over the means of their neighbors; for counts, geometric means,
            because near objects have a thousand times the returns of far ones.
        ratio: real / simulated, and its 95 % interval.
        percentile: mean percentile of the real objects among their nearest neighbors, and its standard error.
    """

    class_name: str
    measure: str
    objects: int
    real: float
    simulated: float
    ratio: float
    ratio_interval: tuple[float, float]
    percentile: float
    percentile_error: float


def compare_objects(real: Sequence[ObjectRecord], simulated: Sequence[ObjectRecord]) -> list[LikeRow]:
    """Return rows of each class that both sides have (for scores also one of all classes)."""
    rows, scores = [], []
    for name in CLASSES:
        of_real = [record for record in real if record.class_name == name]
        of_simulated = [record for record in simulated if record.class_name == name]
        if not of_real or len(of_simulated) < NEIGHBORS:
            continue
        alike, of_like_points = (
            look_alikes(of_real, of_simulated),
            look_alikes(of_real, of_simulated, like_points=True),
        )
        for measure in MEASURES:
            value = np.array([getattr(record, measure) for record in of_real])
            among = np.array([getattr(record, measure) for record in of_simulated])
            among = among[of_like_points if measure == "score" else alike]
            if np.isfinite(value).all() and np.isfinite(among).all():
                rows.append(_row(name, measure, value, among))
                if measure == "score":
                    scores.append((value, among))
    if len(scores) > 1:
        rows.append(_row(ALL, "score", *(np.concatenate(side) for side in zip(*scores, strict=True))))
    return rows


def look_alikes(
    real: Sequence[ObjectRecord], simulated: Sequence[ObjectRecord], *, like_points: bool = False
) -> NDArray[np.int64]:
    """Return the indices (R, NEIGHBORS) of each real object's nearest neighbors among simulated ones of its class."""
    from_real, from_simulated = _place(real, like_points), _place(simulated, like_points)
    away = np.linalg.norm(from_real[:, None] - from_simulated[None], axis=2)
    return np.argsort(away, axis=1, kind="stable")[:, :NEIGHBORS]


def percentiles(value: NDArray[np.float64], among: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the percentile 0..1 of each value (R,) among (R, K); ties count half."""
    below, same = (among < value[:, None]).mean(axis=1), (among == value[:, None]).mean(axis=1)
    return np.asarray(below + 0.5 * same)


def _place(records: Sequence[ObjectRecord], like_points: bool) -> NDArray[np.float64]:
    """Return positions of objects in the space of matching (N, 3 or 4), each axis in units of its span."""
    columns = [
        [np.log(record.distance_m) / DISTANCE_SPAN for record in records],
        [record.view_deg / VIEW_SPAN_DEG for record in records],
        [record.occluded / OCCLUSION_SPAN for record in records],
    ]
    if like_points:
        columns.append([np.log(record.points) / POINTS_SPAN for record in records])
    return np.array(columns).T


def _row(name: str, measure: str, value: NDArray[np.float64], among: NDArray[np.float64]) -> LikeRow:
    counts = measure in _COUNTS
    measured, alike = (np.log(value), np.log(among).mean(axis=1)) if counts else (value, among.mean(axis=1))
    draws = np.random.default_rng(0).integers(len(value), size=(_DRAWS, len(value)))
    with np.errstate(divide="ignore", invalid="ignore"):
        drawn = _ratio(measured[draws].mean(axis=1), alike[draws].mean(axis=1), counts)
        ratio = float(_ratio(measured.mean(), alike.mean(), counts))
    low, high = np.nanpercentile(drawn, (2.5, 97.5)) if np.isfinite(drawn).any() else (np.nan, np.nan)
    rank = percentiles(value, among)
    error = max(float(rank.std()), 1 / np.sqrt(12)) / np.sqrt(len(rank))  # few objects may agree by chance
    real, simulated = (float(np.exp(side.mean()) if counts else side.mean()) for side in (measured, alike))
    interval = float(low), float(high)
    return LikeRow(name, measure, len(value), real, simulated, ratio, interval, float(rank.mean()), error)


def _ratio(
    real: NDArray[np.float64] | np.float64, simulated: NDArray[np.float64] | np.float64, logarithms: bool
) -> NDArray[np.float64]:
    return np.asarray(np.exp(real - simulated) if logarithms else real / simulated)


PERSON_HEIGHT_M, THIN_M = (0.9, 2.2), 1.0
BRIGHT_MEAN = 0.45
FIRING_SCORE = 0.4
KINDS = {
    "person": "person-sized (0.9-2.2 m tall, < 1 m wide)",
    "tall": "tall and thin (> 2.2 m tall, < 1 m wide)",
    "bright": "bright ones of these (mean reflectance >= 0.45)",
}
_CELL_M = 0.25
_FOOT_M = 0.2  # lower returns may be ground, which would connect clusters
_MIN_POINTS = 10  # clusters of fewer are ignored
_NEAR_M = 0.7  # largest distance between a cluster's center and that of a detected box
_AROUND_LABEL_M = 0.4


@dataclass(frozen=True)
class Cluster:
    """Cluster of returns: center, height above the ground and the longer side of its footprint in metres."""

    x_m: float
    y_m: float
    height_m: float
    width_m: float
    reflectance: float
    fires: bool

    @property
    def kinds(self) -> tuple[str, ...]:
        """Keys of KINDS that apply."""
        if self.width_m >= THIN_M or self.height_m < PERSON_HEIGHT_M[0]:
            return ()
        size = "person" if self.height_m <= PERSON_HEIGHT_M[1] else "tall"
        return (size, "bright") if self.reflectance >= BRIGHT_MEAN else (size,)


@dataclass(frozen=True)
class FiringRow:
    """Clusters of one kind: number per frame, and the fraction with a detection with its standard error."""

    kind: str
    frames: int
    clusters: int
    share: float
    error: float

    @property
    def per_frame(self) -> float:
        """Mean number of clusters of this kind per frame."""
        return self.clusters / self.frames


def find_clusters(
    points: NDArray[np.float32], ignored: NDArray[np.bool_], labelled: NDArray[np.float32], detections: Detections
) -> list[Cluster]:
    """Find clusters of at least _MIN_POINTS returns above the ground that touch no labelled box, slightly widened.

    Args:
        points: (N, 4), LiDAR frame.
        ignored: (N,) mask of points in DontCare areas, whose objects are not labelled.
        labelled: (M, 7) boxes of all labelled objects, LiDAR frame.
        detections: detections in the scan.
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
    persons = np.array([name in ("Pedestrian", "Cyclist") for name in detections.names], bool)
    firing = detections.boxes[persons & (detections.scores >= FIRING_SCORE), :2]
    return [_cluster(body[part], height[part], firing) for part in parts if len(part) >= _MIN_POINTS]


def connected(xy_m: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return group numbers (N,) of points (N, 2) whose cells of _CELL_M are connected."""
    cell = np.floor(xy_m / _CELL_M).astype(np.int64)
    cell -= cell.min(axis=0)
    raster = np.zeros(cell.max(axis=0) + 1, np.uint8)
    raster[cell[:, 0], cell[:, 1]] = 1
    _, groups = cv2.connectedComponents(raster, connectivity=8)
    return np.asarray(groups[cell[:, 0], cell[:, 1]], np.int64)


def firing_rows(clusters: Sequence[Cluster], frames: int) -> list[FiringRow]:
    """Return a row of each kind."""
    rows = []
    for kind in KINDS:
        fires = np.array([cluster.fires for cluster in clusters if kind in cluster.kinds], bool)
        count = len(fires)
        share = float(fires.mean()) if count else float("nan")
        # Laplace's estimate in the error alone: none of a few is not certainly a fraction of 0.
        likely = (fires.sum() + 1) / (count + 2)
        rows.append(FiringRow(kind, frames, count, share, float(np.sqrt(likely * (1 - likely) / max(count, 1)))))
    return rows


def _cluster(points: NDArray[np.float32], height: NDArray[np.float64], firing: NDArray[np.float32]) -> Cluster:
    (x, y), sides, _ = cv2.minAreaRect(np.ascontiguousarray(points[:, :2]))
    fires = np.hypot(firing[:, 0] - x, firing[:, 1] - y) < _NEAR_M
    return Cluster(x, y, float(height.max()), max(sides), float(points[:, 3].mean()), bool(fires.any()))


Detect = Callable[[NDArray[np.float32]], Detections]
MAX_FRAMES = 400
MIN_SCORE = 0.02
"""Lowest score that a detector should report for the comparison; lower ones count as 0."""


@dataclass(frozen=True)
class Side:
    """Measurements of the frames of one folder."""

    source: str
    frames: int
    records: list[ObjectRecord]
    clusters: list[Cluster] | None  # None without a detector


@dataclass(frozen=True)
class LikeForLike:
    """Both sides, and the rows that compare them; detection rates are None without a detector."""

    real: Side
    simulated: Side
    rows: list[LikeRow]
    firing: tuple[list[FiringRow], list[FiringRow]] | None
    detector: str | None

    def to_json(self) -> dict[str, Any]:
        """Return all numbers; None for undefined ones (a fraction of no clusters)."""
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


def measure_side(root: str | Path, detect: Detect | None, title: str, reporter: Reporter) -> Side:
    """Measure the frames of `root`/training, at most MAX_FRAMES, evenly spaced, in the camera's field of view.

    Raises:
        DatasetError: there is no scan, or a frame without labels or calibration.
        ScanError: a damaged scan.
    """
    split = KittiSplit(root)
    ids = split.frame_ids
    chosen = np.linspace(0, len(ids) - 1, min(MAX_FRAMES, len(ids))).round().astype(int)
    records: list[ObjectRecord] = []
    clusters: list[Cluster] = []
    for index in reporter.track(chosen, title):
        calibration = split.calibration(ids[index])
        points = read_scan(split.scan_path(ids[index])).points
        points = points[in_image(points, calibration, split.image_size_wh(ids[index]))]
        everything = split.objects(ids[index])
        objects = seen_objects(everything)
        boxes = boxes_from_objects(objects, calibration)
        detections = None if detect is None else detect(points)
        records += record_objects(points, objects, boxes, detections)
        if detections is not None:
            ignored = _in_areas(points, [o.bbox for o in everything if o.type == "DontCare"], calibration)
            clusters += find_clusters(points, ignored, boxes, detections)
    return Side(str(root), len(chosen), records, None if detect is None else clusters)


def compare_like_for_like(
    real_root: str | Path,
    simulated_root: str | Path,
    detect: Detect | None = None,
    detector: str | None = None,
    reporter: Reporter = SILENT,
) -> LikeForLike:
    """Measure both folders and compare them.

    Args:
        real_root: labelled frames in KITTI's layout.
        simulated_root: simulated ones.
        detect: points of a scan -> detections from MIN_SCORE on; without it no scores and no firing rates.
        detector: its name.
        reporter: told of each frame.

    Raises:
        DatasetError: a folder cannot be read, or no class has a real object and enough simulated ones.
    """
    real = measure_side(real_root, detect, "Real frames", reporter)
    simulated = measure_side(simulated_root, detect, "Simulated frames", reporter)
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
    """Return the mask of the points (N, 4), all of them in the image, in one of its areas x1, y1, x2, y2."""
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
