"""Evaluation of tracks over labelled sequences: HOTA, MOTA, identity switches, fragmentations."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError, DatasetError
from asca_pillars.base.files import read_text
from asca_pillars.base.system import describe_environment
from asca_pillars.data.boxes.box_records import NamedRecords
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.boxes.detector_scope import DetectorScope
from asca_pillars.data.open_split import open_split
from asca_pillars.evaluation.arguments import Evaluation, EvaluationTask
from asca_pillars.evaluation.boxes.box_predictions import predictions_by_frame, stated_scope
from asca_pillars.evaluation.report_files import check_output_folder, write_report
from asca_pillars.evaluation.report_page import ReportPage, TextTable
from asca_pillars.evaluation.tracking_metrics import (
    Boxes,
    ClearMot,
    Hota,
    TrackedFrame,
    clear_mot,
    hota,
    tracked_frame,
)
from asca_pillars.scans.find_scans import natural_order

CLEAR_IOU = 0.25
"""Least 3D IoU of a match, for MOTA, identity switches and fragmentations."""
MIN_POINTS = 5
"""Labels with fewer points are not counted, if the dataset states their number."""
UNKNOWN_OCCLUSION = 3


class ClassScore(NamedTuple):
    """Metrics of one class."""

    name: str
    hota: Hota
    clear: ClearMot


@dataclass(frozen=True)
class TrackingReport:
    """Scores, and the numbers of labelled frames and of those with predictions."""

    subject: str
    scores: Sequence[ClassScore]
    frames: int
    frames_found: int
    not_scored: dict[str, int]
    """Number of labels of each class that the detector does not have."""
    scope: DetectorScope | None
    """Scope of the detector; None if the predictions do not state it."""
    outside: int
    """Number of labels of the evaluated classes outside the detector's ranges, which are not counted."""
    hidden: int
    """Number of labels of the evaluated classes within its ranges that are hardly visible and not counted."""
    about: dict[str, Any]

    @property
    def counted(self) -> int:
        """Number of counted labels."""
        return sum(score.clear.labels for score in self.scores)


@dataclass(frozen=True)
class _Frame:
    """Boxes of all classes in one frame, labelled and predicted."""

    labels: Boxes
    types: tuple[str, ...]
    counted: NDArray[np.bool_]
    outside: int
    hidden: int
    detections: Boxes
    detection_types: tuple[str, ...]


def tracking_report(split: BoxSplit, predictions: Path, subject: str, about: dict[str, Any]) -> TrackingReport:
    """Score the tracks written by `asca detect --track`.

    Lines are assigned by `predictions_by_frame`. Labelled frames without a line count as frames without
    detections. Not counted are labels outside the stated ranges of the detector (`stated_scope`), with fewer
    than MIN_POINTS points and of unknown occlusion. Evaluated are the detector's stated classes, and
    those that are predicted.

    Args:
        split: labels with `track_id`; a frame's folder is its sequence.
        predictions: a .jsonl file, or the folder of one.
        subject: description of the tracks.
        about: for the JSON.

    Raises:
        DatasetError: as `predictions_by_frame`; boxes have no `track_id`.
    """
    path = predictions / "detections.jsonl" if predictions.is_dir() else predictions
    by_frame = predictions_by_frame(path, split)
    scope = stated_scope(path, by_frame.values())
    predicted = sorted({kind for line in by_frame.values() for kind in line.records.types})
    names = tuple(dict.fromkeys((*(() if scope is None else scope.classes), *predicted)))
    sequences: dict[str, list[_Frame]] = {}
    labelled: Counter[str] = Counter()
    numbers: dict[str, int] = {}
    outside = hidden = 0
    for frame_id in _in_order(split.frame_ids, split.times_s):
        frame = _frame(split, frame_id, by_frame.get(frame_id), names, scope, numbers)
        labelled.update(frame.types)
        outside, hidden = outside + frame.outside, hidden + frame.hidden
        sequences.setdefault(frame_id.rpartition("/")[0], []).append(frame)
    scores = []
    for name in names:
        frames = [[_of_class(frame, name) for frame in sequence] for sequence in sequences.values()]
        scores.append(ClassScore(name, hota(frames), clear_mot(frames, CLEAR_IOU)))
    not_scored = {kind: count for kind, count in sorted(labelled.items()) if kind not in names}
    return TrackingReport(
        subject, scores, len(split.frame_ids), len(by_frame), not_scored, scope, outside, hidden, about
    )


def tracking_tables(report: TrackingReport) -> list[TextTable]:
    """Return the tables of HOTA with its parts, and of MOTA with its counts; a row for each class."""
    parts = [(score.name, *(f"{100 * value:.1f}" for value in score.hota)) for score in report.scores]
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
    """Return notes on the numbers."""
    notes = [
        "HOTA and its parts by 3D IoU, means over 0.05 to 0.95 (Luiten et al., 2021); MOTA, switches and fragments at "
        f"3D IoU {CLEAR_IOU:g}.",
        _counted_note(report),
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


def _counted_note(report: TrackingReport) -> str:
    total = report.counted + report.outside + report.hidden
    left_out = f"{report.hidden} have fewer than {MIN_POINTS} points or unknown occlusion"
    counted = f"{report.counted} of {total} labels are counted"
    if report.scope is None:
        return (
            f"{counted}, in every direction and at any distance: the predictions do not state the detector's ranges, "
            f"as the lines of asca detect do (`detector`), and labels outside them count as missed; {left_out}."
        )
    if report.scope.ranges_m is None:
        return f"{counted}: the detector's ranges are {report.scope.where()}; {left_out}."
    return f"{counted}: {report.outside} lie outside the detector's ranges, {report.scope.where()}; {left_out}."


def tracking_json(report: TrackingReport) -> dict[str, Any]:
    """Return all numbers; None for those that cannot be computed."""
    classes = {
        score.name: {
            key: None if isinstance(value, float) and np.isnan(value) else value
            for key, value in {
                **score.hota._asdict(),
                **score.clear._asdict(),
                "misses": score.clear.misses,
                "mota": score.clear.mota,
            }.items()
        }
        for score in report.scores
    }
    return report.about | {
        "subject": report.subject,
        "frames": report.frames,
        "frames_found": report.frames_found,
        "not_scored": report.not_scored,
        "detector": None if report.scope is None else report.scope.to_json(),
        "labels_counted": report.counted,
        "labels_outside_ranges": report.outside,
        "labels_hidden": report.hidden,
        "classes": classes,
    }


def _of_class(frame: _Frame, name: str) -> TrackedFrame:
    """Return one class of a frame; boxes that match labels of unpredicted classes are removed."""
    of_class = np.array([kind == name for kind in frame.types], bool)
    foreign = np.array([not counted and kind != name for kind, counted in zip(frame.types, frame.counted, strict=True)])
    rows = np.flatnonzero(of_class | foreign.astype(bool))
    labels = Boxes(frame.labels.boxes[rows], frame.labels.ids[rows])
    columns = np.flatnonzero(np.array([kind == name for kind in frame.detection_types], bool))
    return tracked_frame(
        labels, (frame.counted & of_class)[rows], Boxes(frame.detections.boxes[columns], frame.detections.ids[columns])
    )


def _frame(
    split: BoxSplit,
    frame_id: str,
    predicted: NamedRecords | None,
    names: Sequence[str],
    scope: DetectorScope | None,
    numbers: dict[str, int],
) -> _Frame:
    records = split.records(frame_id)
    known = np.array([kind in names for kind in records.types], bool)
    seen, inside = np.ones(len(known), bool), np.ones(len(known), bool)
    for row, record in enumerate(_label_records(split, frame_id)):
        seen[row] &= _number(record.get("points"), MIN_POINTS) >= MIN_POINTS
        seen[row] &= _number(record.get("occluded"), 0) < UNKNOWN_OCCLUSION
    if scope is not None:
        inside = scope.holds(split.labeled_boxes(frame_id).boxes)  # its axes are level, those of labels may not be
    labels = Boxes(records.boxes, _ids(records.track_ids, str(split.labels_path), numbers))
    counts = known & seen & inside, int((known & ~inside).sum()), int((known & inside & ~seen).sum())
    if predicted is None:
        nothing = Boxes(np.empty((0, 7), np.float32), np.empty(0, np.int64))
        return _Frame(labels, records.types, *counts, nothing, ())
    prediction_records = predicted.records
    boxes = Boxes(prediction_records.boxes, _ids(prediction_records.track_ids, predicted.place, numbers))
    return _Frame(labels, records.types, *counts, boxes, prediction_records.types)


def _label_records(split: BoxSplit, frame_id: str) -> list[dict[str, Any]]:
    """Read a frame's label records with all their keys, if the frame has a file of its own."""
    path = split.labels_path / f"{frame_id}.json"
    return list(json.loads(read_text(path, DatasetError))["boxes"]) if path.is_file() else []


def _number(value: Any, otherwise: float) -> float:
    """Return a label's extra number; in files of other programs the key may have any value."""
    return value if isinstance(value, int | float) else otherwise


def _ids(values: Sequence[Any], place: str, numbers: dict[str, int]) -> NDArray[np.int64]:
    """Return identities (K,) as numbers: those in `numbers`, and new ones for other texts."""
    if None in values:
        raise DatasetError(f"{place}: a box without `track_id`; write tracks with `asca detect --track`")
    texts = [str(value) for value in values]
    if len(set(texts)) < len(texts):
        raise DatasetError(f"{place}: two boxes of one frame have the same `track_id`")
    return np.array([numbers.setdefault(text, len(numbers)) for text in texts], np.int64)


def _in_order(frame_ids: Sequence[str], times: Mapping[str, float]) -> list[str]:
    """Return the frames in order: by time if every frame has one, else in natural order."""
    if all(frame_id in times for frame_id in frame_ids):
        return sorted(frame_ids, key=lambda frame_id: times[frame_id])
    return sorted(frame_ids, key=lambda frame_id: natural_order(Path(frame_id)))


def evaluate_tracks(task: EvaluationTask) -> Evaluation:
    """Score tracks; write the table and the JSON.

    Raises:
        AscaError: a file cannot be read, or has no identities.
    """
    data, predictions, split = task.data, task.predictions, task.split_name
    assert data is not None and predictions is not None, "checked with the arguments"
    labels = open_split(data, split)
    if not isinstance(labels, BoxSplit):
        raise ConfigError(f"--protocol tracking: {data} has no identities; give sequences of asca simulate --sequences")
    check_output_folder("tracking", task.out, task.json, predictions, (data,))
    about = {"data": str(data), "split": split, "predictions": str(predictions), "environment": describe_environment()}
    report = tracking_report(labels, predictions, f"{predictions} against {data}, {split}", about)
    page = ReportPage(report.subject, tracking_tables(report), tracking_notes(report))
    content = tracking_json(report)
    write_report("tracking", page, content, task.out, task.json, predictions)
    return Evaluation("tracking", content, page, None, task.out)
