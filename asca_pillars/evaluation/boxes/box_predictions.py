"""Labelled boxes of a dataset, and predictions of `asca detect` assigned to its frames.

A line of predictions is assigned by the file name of its scan or by its time stamp.
"""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.data.boxes.box_records import NamedRecords, json_line, read_frames, records_from
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.boxes.detector_scope import DetectorScope, scope_from_json
from asca_pillars.data.frames import LabeledSplit
from asca_pillars.detection.detections import Detections
from asca_pillars.evaluation.boxes.box_pairs import EvaluatedFrame
from asca_pillars.evaluation.predictions import shortage
from asca_pillars.geometry.boxes import points_in_boxes

_SAME_TIME_S = 1e-3
_DEEPEST = 64  # folders of a scan's path that are compared


def predictions_by_frame(path: Path, split: LabeledSplit) -> dict[str, NamedRecords]:
    """Assign the lines of a *.jsonl or *.csv file to frames; lines of other frames are left out.

    A message of a recording (a line with a time, whose scan is not a file: `drive.mcap/000003`) is assigned by
    its time. Its number is not a frame's name: a recording may begin later than the dataset. A file is assigned to the
    frame whose id is the longest end of its path; without one, by its time, if it has one.

    Raises:
        DatasetError: the file cannot be read; a line's name and time are of two frames, or its time is of several; a
            frame has two lines; no line can be assigned.
    """
    known, times = set(split.frame_ids), split.times_s if isinstance(split, BoxSplit) else {}
    timed_ids, stamps_s = tuple(times), np.array(list(times.values()))
    predictions: dict[str, NamedRecords] = {}
    for line in read_frames(path):
        frame_id = _frame_of_line(line, known, timed_ids, stamps_s)
        if frame_id in predictions:
            raise DatasetError(
                f"{line.place}: frame {frame_id} has predictions in {predictions[frame_id].place}; merge them"
            )
        if frame_id is not None:
            predictions[frame_id] = line
    if not predictions:
        raise DatasetError(
            f"{path}: no line belongs to a frame of {split.root} such as {min(known)}; name its scans or, for "
            "predictions of a recording, give its labels the recording's `time_s`"
        )
    return predictions


def stated_scope(path: Path, lines: Iterable[NamedRecords]) -> DetectorScope | None:
    """Return the scope of the detector, if all lines state the same; None if it is unknown.

    Lines of earlier versions do not state it; then a `recording.json` in the folder of `path` does.

    Raises:
        DatasetError: that file cannot be read.
    """
    stated = {line.detector for line in lines}
    if stated != {None}:
        return stated.pop() if len(stated) == 1 else None
    recording = path.parent / "recording.json"
    if not recording.is_file():
        return None
    try:
        scope = scope_from_json(json.loads(recording.read_text(encoding="utf-8")))
        if scope is None:
            raise ValueError("it states no classes and ranges")
        return scope
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{recording}: cannot be read ({str(error)[:80]}); run asca detect --track again") from None


def _frame_of_line(
    line: NamedRecords, known: set[str], timed_ids: Sequence[str], stamps_s: NDArray[np.float64]
) -> str | None:
    is_message = line.time_s is not None and not PurePosixPath(line.scan).suffix
    named = None if is_message else _frame_of_scan(line.scan, known)
    if line.time_s is None:
        return named
    timed = [timed_ids[int(row)] for row in np.flatnonzero(np.abs(stamps_s - line.time_s) < _SAME_TIME_S)]
    if named is not None:
        if timed and named in timed_ids and named not in timed:
            raise DatasetError(
                f"{line.place}: {line.scan} names frame {named}, but its time_s {line.time_s:.3f} is that of "
                f"{timed[0]}; correct one of them, or leave time_s out"
            )
        return named
    if len(timed) > 1:
        raise DatasetError(
            f"{line.place}: its time_s {line.time_s:.3f} is that of {timed[0]} and {timed[1]}; list the frames that it "
            "may belong to in ImageSets/, and give --split"
        )
    return timed[0] if timed else None


def _frame_of_scan(scan: str, frame_ids: set[str]) -> str | None:
    """Return the frame whose id is the longest end of a scan's path; None if there is none."""
    path = PurePosixPath(scan.replace("\\", "/"))
    parts = path.with_suffix("").parts[-_DEEPEST:] if path.name else ()
    ends = ("/".join(parts[first:]) for first in range(len(parts)))
    return next((end for end in ends if end in frame_ids), None)


NEAR_LABEL_M = 4.0
"""Distance from an object labelled at the edge of the view: the largest at which any protocol matches."""


@dataclass(frozen=True)
class BoxFrames:
    """Frames with labels and predictions, frames without predictions, and the scope of the detector."""

    frames: tuple[EvaluatedFrame, ...]
    without_predictions: tuple[str, ...]
    scope: DetectorScope | None
    """None if the predictions do not state it."""

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def shortage(self) -> str | None:
        """Sentence to print with every result if not all frames were evaluated; None if all were."""
        return shortage(len(self), self.without_predictions, "no predictions", 'needs a line with "boxes": []')


def write_box_predictions(
    path: Path,
    split: LabeledSplit,
    detect: Callable[[NDArray[np.float32]], Detections],
    *,
    scope: DetectorScope,
    camera_view: bool,
    reporter: Reporter = SILENT,
) -> None:
    """Run a detector over a split and write a line for each frame (`data.boxes.box_records`), in the scan's own frame.

    The detector gets points (N, 4), only those in the camera's view if `camera_view`. Each line states its `scope`.

    Raises:
        DatasetError, ScanError: a frame cannot be read.
    """
    level = split.mounting.level
    with path.open("w", encoding="utf-8") as file:
        for frame_id in reporter.track(split.frame_ids, "Detecting"):
            detections = detect(split.points(frame_id, camera_view=camera_view))
            boxes = detections.boxes if level.is_identity else level.inverse.boxes(detections.boxes)
            records = records_from(boxes, detections.names, detections.scores)
            file.write(json_line(f"{frame_id}{split.scan_path(frame_id).suffix}", records, detector=scope))


def read_box_predictions(path: Path, split: LabeledSplit, *, reporter: Reporter = SILENT) -> BoxFrames:
    """Pair the labels of a split with the predictions of a *.jsonl or *.csv file.

    Boxes are in the scan's own frame, as labels are. Lines are assigned by `predictions_by_frame`; lines
    of other frames are left out, and so are boxes in unlabelled regions.

    Args:
        path: the file, or a folder that `asca detect` wrote.
        split: the labels.
        reporter: for the progress.

    Raises:
        DatasetError: as `predictions_by_frame`; a prediction without a score.
    """
    path = path / "detections.jsonl" if path.is_dir() else path
    predictions = predictions_by_frame(path, split)
    _require_scores(predictions.values())
    level = split.mounting.level
    frames = []
    for frame_id in reporter.track(sorted(predictions), "Points in boxes"):
        objects, types = split.labeled_boxes(frame_id)
        points = split.points(frame_id, camera_view=False)
        visible = np.asarray(points_in_boxes(points, objects).any(axis=0))
        records = predictions[frame_id].records
        detections = records.boxes if level.is_identity else level.boxes(records.boxes)
        kept = np.flatnonzero(_can_be_evaluated(split, frame_id, objects, detections))
        detection_types = tuple(records.types[row] for row in kept)
        frames.append(
            EvaluatedFrame(frame_id, objects, types, visible, detections[kept], detection_types, records.scores[kept])
        )
    missing = tuple(frame_id for frame_id in split.frame_ids if frame_id not in predictions)
    return BoxFrames(tuple(frames), missing, stated_scope(path, predictions.values()))


def _can_be_evaluated(
    split: LabeledSplit, frame_id: str, objects: NDArray[np.float32], detections: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Return the mask of the boxes (N, 7) in the labelled view, or close enough to one of `objects` to match it."""
    apart = np.linalg.norm(detections[:, None, :2] - objects[None, :, :2], axis=2)
    return np.asarray(split.in_labeled_view(frame_id, detections[:, :3]) | (apart < NEAR_LABEL_M).any(axis=1))


def _require_scores(lines: Iterable[NamedRecords]) -> None:
    for line in lines:
        if np.isnan(line.records.scores).any():
            number = int(np.isnan(line.records.scores).argmax()) + 1
            raise DatasetError(f"{line.place}, box {number}: no `score`; every prediction needs one")
