"""Tracking metrics of a run over simulated (or otherwise labelled) sequences: HOTA, MOTA, switches, fragmentations."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.errors import DatasetError
from asca_pillars.evaluation.boxes.box_predictions import frame_of_scan
from asca_pillars.evaluation.report import TextTable
from asca_pillars.evaluation.tracking.clear_mot import ClearMot, clear_mot
from asca_pillars.evaluation.tracking.hota import Hota, hota
from asca_pillars.evaluation.tracking.tracked_frames import Boxes, TrackedFrame, tracked_frame

CLEAR_IOU = 0.25
"""3D IoU from which on a box has found an object, for MOTA, switches and fragmentations."""
MIN_POINTS = 5
"""Labels of fewer points are not counted, where the dataset says how many there are."""
UNKNOWN_OCCLUSION = 3
_SAME_TIME_S = 1e-3


class ClassScore(NamedTuple):
    """All metrics of one class."""

    name: str
    hota: Hota
    clear: ClearMot


@dataclass(frozen=True)
class TrackingReport:
    """The scores, and how many labelled frames there are and have predictions."""

    subject: str
    scores: Sequence[ClassScore]
    frames: int
    frames_found: int
    about: dict[str, Any]


@dataclass(frozen=True)
class _Frame:
    """Boxes of all classes in one frame, labelled and found."""

    labels: Boxes
    types: tuple[str, ...]
    counted: Any
    found: Boxes
    found_types: tuple[str, ...]


def tracking_report(split: BoxSplit, predictions: Path, subject: str, about: dict[str, Any]) -> TrackingReport:
    """Score the tracks that `asca detect --track` wrote.

    A line belongs to the frame of its scan's name or, for recordings, of its time. Labelled frames without a line count
    as frames in which nothing was found. Not counted are labels outside the ranges that the predictions' folder notes
    (recording.json), of fewer than MIN_POINTS points, of unknown occlusion, and of classes that are not predicted.

    Args:
        split: labels with `track_id`; a frame's folder is its sequence.
        predictions: a .jsonl file, or the folder of one.
        subject: in words.
        about: for the JSON.

    Raises:
        DatasetError: a file cannot be read, boxes have no `track_id`, or no line belongs to a frame.
    """
    path = predictions / "detections.jsonl" if predictions.is_dir() else predictions
    lines = _by_frame(path, split)
    names = sorted({box["class"] for line in lines.values() for box in line["boxes"]})
    ranges = _ranges(path.parent / "recording.json")
    sequences: dict[str, list[_Frame]] = {}
    for frame_id in split.frame_ids:
        frame = _frame(split, frame_id, lines.get(frame_id, {"boxes": []}), names, ranges, path)
        sequences.setdefault(frame_id.rpartition("/")[0], []).append(frame)
    scores = []
    for name in names:
        frames = [[_of_class(frame, name) for frame in own] for own in sequences.values()]
        scores.append(ClassScore(name, hota(frames), clear_mot(frames, CLEAR_IOU)))
    return TrackingReport(subject, scores, len(split.frame_ids), len(lines), about)


def tracking_table(report: TrackingReport) -> TextTable:
    """A row for each class."""
    columns = ("class", "HOTA", "DetA", "AssA", "LocA", "MOTA", "switches", "fragments", "labels", "misses", "false")
    rows = []
    for name, one, clear in report.scores:
        means = [f"{100 * value:.1f}" for value in (*one, clear.mota)]
        counts = (clear.identity_switches, clear.fragmentations, clear.labels, clear.misses, clear.false_boxes)
        rows.append((name, *means, *map(str, counts)))
    return TextTable("Tracking", columns, tuple(rows), left=1)


def tracking_notes(report: TrackingReport) -> list[str]:
    """What is to be known beside the numbers."""
    notes = [
        "HOTA and its parts by 3D IoU, means over 0.05 to 0.95 (Luiten et al., 2021); MOTA, switches and fragments at "
        f"3D IoU {CLEAR_IOU:g}."
    ]
    if report.frames_found < report.frames:
        notes.append(
            f"{report.frames - report.frames_found} of {report.frames} labelled frames have no predictions and count "
            "as frames in which nothing was found."
        )
    return notes


def tracking_json(report: TrackingReport) -> dict[str, Any]:
    """Every number; None for what cannot be computed."""
    classes = {
        one.name: {
            key: None if isinstance(value, float) and np.isnan(value) else value
            for key, value in {
                **one.hota._asdict(),
                **one.clear._asdict(),
                "misses": one.clear.misses,
                "mota": one.clear.mota,
            }.items()
        }
        for one in report.scores
    }
    return report.about | {
        "subject": report.subject,
        "frames": report.frames,
        "frames_found": report.frames_found,
        "classes": classes,
    }


def _of_class(frame: _Frame, name: str) -> TrackedFrame:
    """One class of a frame; labels of other classes than those predicted take their boxes away."""
    own = np.array([kind == name for kind in frame.types], bool)
    foreign = np.array([not counted and kind != name for kind, counted in zip(frame.types, frame.counted, strict=True)])
    rows = np.flatnonzero(own | foreign.astype(bool))
    labels = Boxes(frame.labels.boxes[rows], frame.labels.ids[rows])
    columns = np.flatnonzero(np.array([kind == name for kind in frame.found_types], bool))
    return tracked_frame(
        labels, (frame.counted & own)[rows], Boxes(frame.found.boxes[columns], frame.found.ids[columns])
    )


def _frame(
    split: BoxSplit,
    frame_id: str,
    line: dict[str, Any],
    names: list[str],
    ranges: tuple[tuple[float, float], tuple[float, float]] | None,
    path: Path,
) -> _Frame:
    records = split.records(frame_id)
    more = _label_records(split, frame_id)
    counted = np.array([kind in names for kind in records.types], bool)
    for row, record in enumerate(more):
        counted[row] &= record.get("points", MIN_POINTS) >= MIN_POINTS
        counted[row] &= record.get("occluded", 0) < UNKNOWN_OCCLUSION
    if ranges is not None:
        for axis, (low, high) in enumerate(ranges):
            counted &= (records.boxes[:, axis] >= low) & (records.boxes[:, axis] <= high)
    labels = Boxes(records.boxes, _ids(records.track_ids, str(split.labels_path)))
    fields = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad")
    boxes = np.array([[box[name] for name in fields] for box in line["boxes"]], np.float32).reshape(-1, 7)
    found = Boxes(boxes, _ids([box.get("track_id") for box in line["boxes"]], f"{path}, {frame_id}"))
    return _Frame(labels, records.types, counted, found, tuple(box["class"] for box in line["boxes"]))


def _label_records(split: BoxSplit, frame_id: str) -> list[dict[str, Any]]:
    """A frame's label records with all their keys, where the frame has a file of its own."""
    path = split.labels_path / f"{frame_id}.json"
    return list(json.loads(path.read_text(encoding="utf-8"))["boxes"]) if path.is_file() else []


def _ids(values: Sequence[Any], place: str) -> Any:
    """Identities (K,) as numbers; other texts than numbers are numbered by their hash."""
    if None in values:
        raise DatasetError(f"{place}: a box without `track_id`; write tracks with `asca detect --track`")
    texts = [str(value) for value in values]
    if len(set(texts)) < len(texts):
        raise DatasetError(f"{place}: two boxes of one frame have the same `track_id`")
    return np.array([int(text) if text.isdecimal() else hash(text) >> 24 for text in texts], np.int64)


def _by_frame(path: Path, split: BoxSplit) -> dict[str, dict[str, Any]]:
    """The lines of the predictions by the frames that they belong to."""
    try:
        lines = [json.loads(text) for text in path.read_text(encoding="utf-8").splitlines() if text.strip()]
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: cannot be read as JSON lines ({str(error)[:80]}); correct the path") from None
    known = set(split.frame_ids)
    times = _times(split)
    order = np.array(sorted(times))
    found: dict[str, dict[str, Any]] = {}
    for line in lines:
        frame_id = frame_of_scan(str(line.get("scan", "")), known) or ""
        if not frame_id and "time_s" in line and len(order):
            nearest = float(order[np.abs(order - line["time_s"]).argmin()])
            frame_id = times[nearest] if abs(nearest - line["time_s"]) < _SAME_TIME_S else ""
        if frame_id:
            found[frame_id] = line
    if not found:
        raise DatasetError(f"{path}: no line belongs to a frame of {split.root}, by name or by time")
    return found


def _times(split: BoxSplit) -> dict[float, str]:
    """Time stamp, seconds -> frame, where labels say it."""
    times = {}
    for frame_id in split.frame_ids:
        path = split.labels_path / f"{frame_id}.json"
        if path.is_file():
            content = json.loads(path.read_text(encoding="utf-8"))
            if "time_s" in content:
                times[float(content["time_s"])] = frame_id
    return times


def _ranges(path: Path) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Where the detector looked, if its results say so: x and y in metres."""
    if not path.is_file():
        return None
    ranges = json.loads(path.read_text(encoding="utf-8")).get("ranges_m")
    return None if ranges is None else (tuple(ranges[0]), tuple(ranges[1]))
