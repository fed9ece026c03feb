"""Detection metrics of the Waymo Open Dataset: AP, and APH, in which true positives are weighted by heading accuracy.

Definition: P. Sun et al., "Scalability in Perception for Autonomous Driving: Waymo Open Dataset", CVPR 2020
(arXiv 1912.04838); for details, the dataset's own evaluation tool:

- Boxes match by a 3D IoU of at least 0.7 for vehicles and 0.5 for every other class, one to one within a frame and a
  class, with the largest sum of IoU. Scores do not affect it: for each cutoff 0, 0.01, ..., 1 the detections
  with at least that score are matched anew.
- Labels without a LiDAR point are not counted. Objects with up to 5 points are LEVEL_2. At LEVEL_2
  every object counts. At LEVEL_1 an unfound LEVEL_2 object is not missed, but a found one is a true positive
  like any other, in the precision and on both sides of the recall.
- A true positive has the heading accuracy 1 - d / pi, d in [0, pi] being the difference of the headings. APH uses the
  sum of these instead of the number of true positives, in the precision but not in the recall.
- Precision at a recall is the maximum at that recall or higher. The area under it is that of trapezoids, but between
  recalls more than 0.05 apart precision falls only in the last step, which is at most 0.05 wide.
- A range keeps the objects *and* the detections whose own centers are in it, by 3D distance from the origin; boxes
  on two sides of a limit do not match.
- An unmatched detection in a no-label zone is not a false positive.

Table 7 of AFE-RCNN (2022) lists vehicles and cyclists, both levels, over all ranges; its text counts objects with 5
points as LEVEL_1, unlike the tool.

Differences: a level without objects has no AP (the tool gives 0, or uses the LEVEL_2 objects that were found). Where
several matchings have the same sum of IoU, the tool's depends on the order in the file, false positives
included: its matching is complete, and a detection that overlaps no object may be assigned one at weight 0. It also
rounds IoU to 1e-6, so that more sums are equal. Here the order of detections of different scores has no influence: the
higher score keeps its object, and of equal objects the first one is matched. LEVEL_1 can differ by this, because it
matters there whether an unmatched object is of LEVEL_1 or of LEVEL_2, and so can APH. Papers that let the tool choose
11 cutoffs by the distribution of the scores get slightly different results.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.targets import UNMATCHED, best_assignments
from asca_pillars.evaluation.kitti.average_precision import CLASS_NAMES
from asca_pillars.evaluation.kitti.objects import FrameObjects, Frames, dont_care_shares, is_neighbor
from asca_pillars.evaluation.kitti.score_threshold import DONT_CARE_SHARE
from asca_pillars.evaluation.predictions import FOLDED_KITTI_TYPES, ScoredFrames
from asca_pillars.evaluation.report_page import TextTable
from asca_pillars.geometry.boxes import points_in_boxes, wrap_angle
from asca_pillars.geometry.overlap import iou_3d
from asca_pillars.scans.scan_reader import read_scan

LEVELS = (1, 2)
EVERYWHERE = (0.0, inf)
RANGES_M = (EVERYWHERE, (0.0, 30.0), (30.0, 50.0), (50.0, inf))
SCORE_CUTOFFS = (np.arange(101) * 0.01).astype(np.float32)
VEHICLES = ("vehicle", "car")  # compared without case
VEHICLE_MIN_IOU = 0.7
SMALL_MIN_IOU = 0.5
LEVEL_2_POINTS = 5
MAX_RECALL_STEP = 0.05

_Doubles = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class WaymoTruth:
    """N labelled objects of one frame.

    Raises:
        ValueError: if the arrays do not describe the same number of objects.
    """

    boxes: NDArray[np.floating]
    """(N, 7) x, y, z, length, width, height, yaw; metres and radians, vehicle (or LiDAR) frame."""
    labels: NDArray[np.int64]
    """(N,) indices into the detections' `class_names`; negative for objects that are not evaluated."""
    levels: NDArray[np.int64]
    """(N,) 1 or 2, or 0 for an object without points: see `difficulty_levels`."""

    def __post_init__(self) -> None:
        shapes = self.boxes.shape, self.labels.shape, self.levels.shape
        count = len(self.labels)
        if shapes != ((count, 7), (count,), (count,)):
            raise ValueError(f"boxes, labels and levels must have shapes (N, 7), (N,) and (N,), not {shapes}")


@dataclass(frozen=True)
class WaymoScore:
    """AP and APH of one class at one level, in percent; None if there are no such objects."""

    class_name: str
    level: int
    range_m: tuple[float, float]
    objects: int
    ap: float | None
    aph: float | None


def difficulty_levels(points: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return the levels of objects from their number of LiDAR points: (N,) -> (N,) 0 without points, else 1 or 2."""
    return np.where(points > 0, np.where(points <= LEVEL_2_POINTS, 2, 1), 0)


def min_iou(class_name: str) -> float:
    """Return the least 3D IoU of a match: 0.7 for vehicles, 0.5 for every other class."""
    return VEHICLE_MIN_IOU if class_name.casefold() in VEHICLES else SMALL_MIN_IOU


def waymo_detection(
    truth: Sequence[WaymoTruth],
    detections: Sequence[Detections],
    *,
    no_label: Sequence[NDArray[np.bool_]] | None = None,
    reporter: Reporter = SILENT,
) -> list[WaymoScore]:
    """Compute AP and APH for every class of the detections, level and range, in that order.

    Args:
        truth: labels of each frame.
        detections: detections of the same frames, in the same order and coordinates, scores within [0, 1]. A frame
            without detections has an empty one.
        no_label: (D,) of each frame, whether a detection is in a no-label zone. None without such zones.
        reporter: for the progress.

    Raises:
        ValueError: the sequences are empty or of different length, frames have different class names, or a score
            lies outside [0, 1].
    """
    class_names = _checked_class_names(truth, detections)
    tallies = {(index, span): _Tally() for index in range(len(class_names)) for span in RANGES_M}
    zones = [np.zeros(len(predicted), dtype=bool) for predicted in detections] if no_label is None else no_label
    frames = list(zip(truth, detections, zones, strict=True))
    for labelled, predicted, zone in reporter.track(frames, "Evaluating"):
        for index, name in enumerate(class_names):
            of_class = (labelled.labels == index) & (labelled.levels > 0)
            detected = predicted.labels == index
            frame = _frame(
                labelled.boxes[of_class], labelled.levels[of_class], predicted[detected], zone[detected], name
            )
            for span in RANGES_M:
                tallies[index, span].add(frame.within(span))
    return [
        tallies[index, span].score(name, level, span)
        for index, name in enumerate(class_names)
        for level in LEVELS
        for span in RANGES_M
    ]


def mean_over_classes(
    scores: Sequence[WaymoScore], level: int, range_m: tuple[float, float] = EVERYWHERE
) -> tuple[float, float]:
    """Compute mAP and mAPH in percent over the classes with objects at that level and range; NaN if none has."""
    rows = [(item.ap, item.aph) for item in scores if (item.level, item.range_m) == (level, range_m)]
    known = np.array([row for row in rows if None not in row], dtype=np.float64).reshape(-1, 2)
    ap, aph = known.mean(axis=0) if len(known) else (np.nan, np.nan)
    return float(ap), float(aph)


@dataclass(frozen=True, eq=False)
class _Frame:
    """One class in one frame: N detections by descending score, M objects."""

    scores: NDArray[np.float32]  # (N,)
    no_label: NDArray[np.bool_]  # (N,)
    distances_m: _Doubles  # (N,)
    iou: _Doubles  # (N, M), 0 where it is too small to match
    heading_accuracy: _Doubles  # (N, M)
    object_distances_m: _Doubles  # (M,)
    levels: NDArray[np.int64]  # (M,)

    def within(self, range_m: tuple[float, float]) -> "_Frame":
        if range_m == EVERYWHERE:
            return self
        rows = (self.distances_m >= range_m[0]) & (self.distances_m < range_m[1])
        columns = (self.object_distances_m >= range_m[0]) & (self.object_distances_m < range_m[1])
        both = np.ix_(rows, columns)
        return _Frame(
            self.scores[rows],
            self.no_label[rows],
            self.distances_m[rows],
            self.iou[both],
            self.heading_accuracy[both],
            self.object_distances_m[columns],
            self.levels[columns],
        )


def _frame(
    boxes: NDArray[np.floating],
    levels: NDArray[np.int64],
    detections: Detections,
    no_label: NDArray[np.bool_],
    class_name: str,
) -> _Frame:
    order = np.argsort(-detections.scores, kind="stable")
    detections = detections[order]
    iou = iou_3d(detections.boxes, boxes)
    iou[iou < min_iou(class_name)] = 0.0
    turned = wrap_angle(detections.boxes[:, None, 6].astype(np.float64) - boxes[None, :, 6])
    return _Frame(
        scores=detections.scores,
        no_label=no_label[order],
        distances_m=np.linalg.norm(detections.boxes[:, :3].astype(np.float64), axis=1),
        iou=iou,
        heading_accuracy=1 - np.abs(turned) / np.pi,
        object_distances_m=np.linalg.norm(boxes[:, :3].astype(np.float64), axis=1),
        levels=levels,
    )


class _Tally:
    """Counts of one class in one range at every cutoff, over the frames."""

    def __init__(self) -> None:
        self.objects = np.zeros(len(LEVELS), dtype=np.int64)  # up to each level
        # At each cutoff: true and false positives, heading accuracies, and objects missed at each level.
        self.detections = np.zeros(len(SCORE_CUTOFFS))
        self.finds = np.zeros(len(SCORE_CUTOFFS))
        self.heading_accuracy = np.zeros(len(SCORE_CUTOFFS))
        self.missed = np.zeros((len(LEVELS), len(SCORE_CUTOFFS)))

    def add(self, frame: _Frame) -> None:
        reached = np.searchsorted(-frame.scores, -SCORE_CUTOFFS, side="right")  # detections with score >= cutoff
        holders = best_assignments(frame.iou)
        held = holders != UNMATCHED
        accuracy = np.zeros(held.shape)
        columns = np.nonzero(held)[1]
        accuracy[held] = frame.heading_accuracy[holders[held], columns]
        ignored = np.cumsum([0, *frame.no_label])
        np.subtract.at(ignored, np.nonzero(held)[0], frame.no_label[holders[held]])
        self.detections += reached - ignored[reached]
        self.finds += held.sum(axis=1)[reached]
        self.heading_accuracy += accuracy.sum(axis=1)[reached]
        for row, level in enumerate(LEVELS):
            counted = frame.levels <= level
            self.objects[row] += counted.sum()
            self.missed[row] += (~held[:, counted]).sum(axis=1)[reached]

    def score(self, class_name: str, level: int, range_m: tuple[float, float]) -> WaymoScore:
        row = LEVELS.index(level)
        objects = int(self.objects[row])
        if not objects:
            return WaymoScore(class_name, level, range_m, 0, None, None)
        recall = self.finds / (self.finds + self.missed[row])
        detections = np.maximum(self.detections, 1)
        ap = _average_precision(recall, self.finds / detections)
        aph = _average_precision(recall, self.heading_accuracy / detections)
        return WaymoScore(class_name, level, range_m, objects, 100 * ap, 100 * aph)


def _average_precision(recall: _Doubles, precision: _Doubles) -> float:
    """Compute the area under precision over recall, fractions (K,), in any order."""
    levels, group = np.unique(recall[recall > 0], return_inverse=True)
    best = np.zeros(len(levels))
    np.maximum.at(best, group, precision[recall > 0])
    best = np.maximum.accumulate(best[::-1])[::-1]
    area = lower = 0.0
    # Down to recall 0, where precision is undefined, the curve is constant.
    at_lower = best[0] if len(best) else 0.0
    for upper, at_upper in zip(levels, best, strict=True):
        gap = upper - lower
        sloping = gap - MAX_RECALL_STEP * max(np.ceil((gap - 1e-6) / MAX_RECALL_STEP) - 1, 0)
        area += (gap - sloping) * at_upper + sloping * (at_lower + at_upper) / 2
        lower, at_lower = upper, at_upper
    return float(area)


def _checked_class_names(truth: Sequence[WaymoTruth], detections: Sequence[Detections]) -> tuple[str, ...]:
    if len(truth) != len(detections) or not truth:
        raise ValueError(f"{len(truth)} labelled frames and {len(detections)} with detections: need the same, not 0")
    for index, frame in enumerate(detections):
        if frame.class_names != detections[0].class_names:
            raise ValueError(f"frame {index} has classes {frame.class_names}, frame 0 {detections[0].class_names}")
        if not ((frame.scores >= 0) & (frame.scores <= 1)).all():
            raise ValueError(f"frame {index}: scores must lie within [0, 1]")
    return detections[0].class_names


_LEVEL_2 = 2


class WaymoFrames(NamedTuple):
    """Arguments of `waymo_detection`: labels, detections and no-label zones of the same frames."""

    truth: list[WaymoTruth]
    detections: list[Detections]
    no_label: list[NDArray[np.bool_]]


def evaluated_classes(frames: ScoredFrames) -> tuple[str, ...]:
    """Return KITTI's classes that occur, then other classes of the detections or labels."""
    labelled = {name.casefold(): name for frame in frames.truth for name in frame.types}
    detected = {name.casefold(): name for frame in frames.detections for name in frame.types}
    named = detected | labelled  # the spelling of the labels has priority
    official = [name for name in CLASS_NAMES if name.casefold() in named]
    others = [key for key in named if key in detected or key not in FOLDED_KITTI_TYPES]
    folded = {name.casefold() for name in (*CLASS_NAMES, "DontCare")}
    return (*official, *sorted(named[key] for key in others if key not in folded))


def waymo_frames(
    frames: ScoredFrames, class_names: Sequence[str], split: KittiSplit | None, *, reporter: Reporter = SILENT
) -> WaymoFrames:
    """Convert labels and detections of KITTI text to one upright frame, with levels and no-label zones.

    Args:
        frames: labels and predictions.
        class_names: evaluated classes.
        split: dataset of the scans and calibrations; None without any.
        reporter: for the progress.

    Raises:
        DatasetError, ScanError: a score outside [0, 1]; a scan or calibration that cannot be read.
    """
    result = WaymoFrames([], [], [])
    pairs = list(zip(frames.truth, frames.detections, strict=True))
    for truth, detected in reporter.track(pairs, "Points in boxes"):
        detections, no_label = _detections(truth, detected, tuple(class_names))
        result.truth.append(_truth(truth, class_names, split))
        result.detections.append(detections)
        result.no_label.append(no_label)
    return result


def upright_boxes(objects: FrameObjects) -> NDArray[np.float64]:
    """Return (N, 7) x, y, z of the center, length, width, height, yaw; m and rad, x forward, y left, z up."""
    height, width, length = objects.dimensions_hwl.T
    right, down, forward = objects.locations.T
    yaw = wrap_angle(-objects.rotation_y - np.pi / 2)
    return np.stack([forward, -right, height / 2 - down, length, width, height, yaw], axis=1)


def _truth(objects: FrameObjects, class_names: Sequence[str], split: KittiSplit | None) -> WaymoTruth:
    boxes, labels = upright_boxes(objects), _labels(objects, class_names)
    boxes, labels = boxes[labels >= 0], labels[labels >= 0]
    if split is None:
        return WaymoTruth(boxes, labels, np.full(len(boxes), _LEVEL_2))
    points = read_scan(split.scan_path(objects.frame_id)).points
    right, down, forward = split.calibration(objects.frame_id).rect_from_lidar(points[:, :3]).T
    inside = points_in_boxes(np.stack([forward, -right, -down], axis=1), boxes)
    return WaymoTruth(boxes, labels, difficulty_levels(inside.sum(axis=0)))


def _detections(
    truth: FrameObjects, detected: FrameObjects, class_names: tuple[str, ...]
) -> tuple[Detections, NDArray[np.bool_]]:
    """Return the D detections of the classes, and the mask (D,) of those in a substitute of a no-label zone."""
    labels = _labels(detected, class_names)
    known = labels >= 0
    wrong = detected.scores[known & ((detected.scores < 0) | (detected.scores > 1))]
    if len(wrong):
        raise DatasetError(
            f"frame {detected.frame_id}: score {wrong[0]:g}; Waymo's metric cuts off at 0, 0.01 .. 1: "
            "scale the scores of the predictions to [0, 1]"
        )
    boxes, scores = upright_boxes(detected)[known].astype(np.float32), detected.scores[known].astype(np.float32)
    zones = dont_care_shares(Frames.join([truth], [detected]))[known] > DONT_CARE_SHARE
    for label, name in enumerate(class_names):
        of_class = labels[known] == label
        neighbors = is_neighbor(truth, name) & (_labels(truth, class_names) < 0)
        zones[of_class] |= np.any(iou_3d(boxes[of_class], upright_boxes(truth)[neighbors]) >= min_iou(name), axis=1)
    return Detections(boxes, scores, labels[known], class_names), zones


def _labels(objects: FrameObjects, class_names: Sequence[str]) -> NDArray[np.int64]:
    """Return the index (N,) of each object's class; -1 for other types and for objects without a 3D box."""
    index = {name.casefold(): label for label, name in enumerate(class_names)}
    labels = np.array([index.get(name, -1) for name in objects.folded_types.tolist()], dtype=np.int64)
    return np.where(objects.dimensions_hwl.min(axis=1, initial=np.inf) > 0, labels, -1)


@dataclass(frozen=True)
class WaymoReport:
    """Result of an evaluation by Waymo's metric, with all its numbers."""

    subject: str
    """Description of the model or folder and the data."""
    frames: ScoredFrames
    scores: Sequence[WaymoScore]
    has_points: bool
    """True if the levels come from scans."""
    about: dict[str, Any]
    """Model, command, machine and versions, for the JSON."""

    @property
    def title(self) -> str:
        """Subject and number of frames."""
        return self.frames.title_of(self.subject)


def waymo_table(report: WaymoReport) -> TextTable:
    """Return a table with a row for every class and range, and the class means; two columns for each level."""
    rows = []
    for name in dict.fromkeys(score.class_name for score in report.scores):
        for span in RANGES_M:
            scores = [item for item in report.scores if (item.class_name, item.range_m) == (name, span)]
            by_level = sorted(scores, key=lambda item: item.level)
            cells = [cell for item in by_level for cell in (_percent(item.ap), _percent(item.aph), str(item.objects))]
            rows.append((name, _range_text(span), *cells))
    for span in RANGES_M:
        means = [mean_over_classes(report.scores, level, span) for level in LEVELS]
        rows.append(("mean", _range_text(span), *(cell for ap, aph in means for cell in (_mean(ap), _mean(aph), ""))))
    columns = [f"L{level}\n{what}" for level in LEVELS for what in ("AP", "APH", "objects")]
    title = "AP and APH (%) of Waymo's metric at LEVEL_1 and LEVEL_2, 3D IoU 0.7 for vehicles and 0.5 for the others"
    return TextTable(title, ("class", "distance", *columns), tuple(rows))


def waymo_notes(report: WaymoReport) -> list[str]:
    """Return notes on the table."""
    if report.has_points:
        return []
    return ["LEVEL_1 is not evaluated: levels come from the LiDAR points in the boxes; give --data ROOT with the scans"]


def waymo_json(report: WaymoReport) -> dict[str, Any]:
    """Return the whole report: a record for every class, level and range, and the means; percent."""
    return {
        "protocol": "waymo",
        "subject": report.subject,
        "frames": len(report.frames),
        "frames_asked": report.frames.requested,
        "frames_without_predictions": list(report.frames.without_predictions),
        "shortage": report.frames.shortage,
        "results": [
            {
                "class_name": item.class_name,
                "level": item.level,
                **_range_json(item.range_m),
                "objects": item.objects,
                "AP": item.ap,
                "APH": item.aph,
            }
            for item in report.scores
        ],
        "means": [_mean_json(report, level, span) for level in LEVELS for span in RANGES_M],
        "notes": waymo_notes(report),
        **report.about,
    }


def _mean_json(report: WaymoReport, level: int, span: tuple[float, float]) -> dict[str, Any]:
    ap, aph = (value if isfinite(value) else None for value in mean_over_classes(report.scores, level, span))
    return {"level": level, **_range_json(span), "mAP": ap, "mAPH": aph}


def _range_json(span: tuple[float, float]) -> dict[str, float | None]:
    """Return a range for JSON, which has no infinity: a range without an end has None there."""
    low_m, high_m = span
    return {"low_m": low_m, "high_m": high_m if isfinite(high_m) else None}


def _range_text(span: tuple[float, float]) -> str:
    low_m, high_m = span
    if isfinite(high_m):
        return f"{low_m:g}-{high_m:g} m"
    return f"{low_m:g}+ m" if low_m else "all"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _mean(value: float) -> str:
    return _percent(value if isfinite(value) else None)
