"""Tracking metrics of a run over simulated (or otherwise labelled) sequences: HOTA, MOTA, switches, fragmentations."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.boxes.box_records import NamedRecords
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.scans.find_scans import natural_order
from asca_pillars.errors import DatasetError
from asca_pillars.evaluation.boxes.predicted_frames import predictions_by_frame
from asca_pillars.evaluation.report_page import TextTable
from asca_pillars.evaluation.tracking.clear_mot import ClearMot, clear_mot
from asca_pillars.evaluation.tracking.hota import Hota, hota
from asca_pillars.evaluation.tracking.tracked_frames import Boxes, TrackedFrame, tracked_frame

CLEAR_IOU = 0.25
"""3D IoU from which on a box has found an object, for MOTA, switches and fragmentations."""
MIN_POINTS = 5
"""Labels of fewer points are not counted, where the dataset says how many there are."""
UNKNOWN_OCCLUSION = 3


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
    not_scored: dict[str, int]
    """How many labels there are of each class that is not scored, because the detector does not know it."""
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

    `predictions_by_frame` says which frame a line belongs to. Labelled frames without a line count as frames in which
    nothing was found. Not counted are labels outside the ranges that the predictions' folder notes (recording.json), of
    fewer than MIN_POINTS points and of unknown occlusion. Scored are the detector's classes, which the folder notes,
    too; without it those that are predicted.

    Args:
        split: labels with `track_id`; a frame's folder is its sequence.
        predictions: a .jsonl file, or the folder of one.
        subject: in words.
        about: for the JSON.

    Raises:
        DatasetError: as `predictions_by_frame`; boxes have no `track_id`.
    """
    path = predictions / "detections.jsonl" if predictions.is_dir() else predictions
    found = predictions_by_frame(path, split)
    about_run = _about_run(path.parent / "recording.json")
    names = about_run.get("classes") or sorted({kind for one in found.values() for kind in one.records.types})
    sequences: dict[str, list[_Frame]] = {}
    labelled: Counter[str] = Counter()
    numbers: dict[str, int] = {}
    for frame_id in _in_order(split.frame_ids, split.times_s):
        frame = _frame(split, frame_id, found.get(frame_id), names, about_run.get("ranges_m"), numbers)
        labelled.update(frame.types)
        sequences.setdefault(frame_id.rpartition("/")[0], []).append(frame)
    scores = []
    for name in names:
        frames = [[_of_class(frame, name) for frame in own] for own in sequences.values()]
        scores.append(ClassScore(name, hota(frames), clear_mot(frames, CLEAR_IOU)))
    not_scored = {kind: count for kind, count in sorted(labelled.items()) if kind not in names}
    return TrackingReport(subject, scores, len(split.frame_ids), len(found), not_scored, about)


def tracking_tables(report: TrackingReport) -> list[TextTable]:
    """HOTA with its parts, and MOTA with its counts; a row for each class."""
    parts = [(one.name, *(f"{100 * value:.1f}" for value in one.hota)) for one in report.scores]
    counts = [
        (
            name,
            f"{100 * clear.mota:.1f}",
            *map(str, (clear.identity_switches, clear.fragmentations, clear.labels, clear.misses, clear.false_boxes)),
        )
        for name, _, clear in report.scores
    ]
    columns = ("class", "MOTA", "switches", "fragments", "labels", "misses", "false")
    return [
        TextTable("HOTA (%)", ("class", "HOTA", "DetA", "AssA", "LocA"), tuple(parts), left=1),
        TextTable("MOTA (%)", columns, tuple(counts), left=1),
    ]


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
    if report.not_scored:
        classes = ", ".join(f"{name} ({count})" for name, count in report.not_scored.items())
        notes.append(f"Labelled and not scored, because no prediction is of such a class: {classes}.")
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
        "not_scored": report.not_scored,
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
    found: NamedRecords | None,
    names: Sequence[str],
    ranges: Any | None,
    numbers: dict[str, int],
) -> _Frame:
    records = split.records(frame_id)
    counted = np.array([kind in names for kind in records.types], bool)
    for row, record in enumerate(_label_records(split, frame_id)):
        counted[row] &= _number(record.get("points"), MIN_POINTS) >= MIN_POINTS
        counted[row] &= _number(record.get("occluded"), 0) < UNKNOWN_OCCLUSION
    if ranges is not None:
        level = split.labeled_boxes(frame_id).boxes  # ranges are the model's, labels may lie in other axes
        for axis, (low, high) in enumerate(ranges):
            counted &= (level[:, axis] >= low) & (level[:, axis] <= high)
    labels = Boxes(records.boxes, _ids(records.track_ids, str(split.labels_path), numbers))
    if found is None:
        return _Frame(labels, records.types, counted, Boxes(np.empty((0, 7), np.float32), np.empty(0, np.int64)), ())
    own = found.records
    return _Frame(
        labels, records.types, counted, Boxes(own.boxes, _ids(own.track_ids, found.place, numbers)), own.types
    )


def _label_records(split: BoxSplit, frame_id: str) -> list[dict[str, Any]]:
    """A frame's label records with all their keys, where the frame has a file of its own."""
    path = split.labels_path / f"{frame_id}.json"
    return list(json.loads(path.read_text(encoding="utf-8"))["boxes"]) if path.is_file() else []


def _number(value: Any, otherwise: float) -> float:
    """A number that a label states beside its box; others' files may hold anything under the same key."""
    return value if isinstance(value, int | float) else otherwise


def _ids(values: Sequence[Any], place: str, numbers: dict[str, int]) -> NDArray[np.int64]:
    """Identities (K,) as numbers: those that `numbers` has, and new ones for texts that it has not."""
    if None in values:
        raise DatasetError(f"{place}: a box without `track_id`; write tracks with `asca detect --track`")
    texts = [str(value) for value in values]
    if len(set(texts)) < len(texts):
        raise DatasetError(f"{place}: two boxes of one frame have the same `track_id`")
    return np.array([numbers.setdefault(text, len(numbers)) for text in texts], np.int64)


def _in_order(frame_ids: Sequence[str], times: Mapping[str, float]) -> list[str]:
    """As they followed each other: by time where every frame has one, else 2 before 10."""
    if all(frame_id in times for frame_id in frame_ids):
        return sorted(frame_ids, key=lambda frame_id: times[frame_id])
    return sorted(frame_ids, key=lambda frame_id: natural_order(Path(frame_id)))


def _about_run(path: Path) -> dict[str, Any]:
    """What `asca detect` notes of itself beside its results: its classes, and x and y in metres where it looked."""
    if not path.is_file():
        return {}
    try:
        about = dict(json.loads(path.read_text(encoding="utf-8")))
        about["classes"] = [str(name) for name in about.get("classes") or ()]
        if about.get("ranges_m") is not None:
            about["ranges_m"] = [(float(low), float(high)) for low, high in about["ranges_m"][:3]]
        return about
    except (OSError, ValueError, TypeError, LookupError, OverflowError, RecursionError) as error:
        raise DatasetError(f"{path}: cannot be read ({str(error)[:80]}); run asca detect --track again") from None
