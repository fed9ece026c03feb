"""What is evaluated without a camera: a dataset's labelled boxes, and predictions as `asca detect` writes them."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from asca_pillars.base.errors import DatasetError
from asca_pillars.data.boxes.box_records import NamedRecords, json_line, records_from
from asca_pillars.data.boxes.detector_scope import DetectorScope
from asca_pillars.data.labeled_split import LabeledSplit
from asca_pillars.detection.detections import Detections
from asca_pillars.evaluation.boxes.box_pairs import EvaluatedFrame
from asca_pillars.evaluation.boxes.predicted_frames import predictions_by_frame, stated_scope
from asca_pillars.evaluation.predictions import shortage
from asca_pillars.geometry.boxes import points_in_boxes

NEAR_LABEL_M = 4.0
"""From an object that is labelled at the edge of the view: the largest distance at which any protocol matches."""


@dataclass(frozen=True)
class BoxFrames:
    """Frames with labels and predictions, those that have no predictions, and what the detector could have found."""

    frames: tuple[EvaluatedFrame, ...]
    without_predictions: tuple[str, ...]
    scope: DetectorScope | None
    """None where the predictions do not state it."""

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def shortage(self) -> str | None:
        """One sentence that belongs beside every number if not all frames were evaluated; None if all were."""
        return shortage(len(self), self.without_predictions, "no predictions", 'needs a line with "boxes": []')


def write_box_predictions(
    path: Path,
    split: LabeledSplit,
    detect: Callable[[NDArray[np.float32]], Detections],
    *,
    scope: DetectorScope,
    camera_view: bool,
    console: Console | None = None,
) -> None:
    """Run a detector over a split and write a line for each frame (`data.boxes.box_records`), in the scan's own frame.

    The detector gets points (N, 4), only those in the camera's view if `camera_view`. Each line states its `scope`.

    Raises:
        DatasetError, ScanError: a frame cannot be read.
    """
    level = split.mounting.level
    with path.open("w", encoding="utf-8") as file:
        for frame_id in track(split.frame_ids, "Detecting", console=console, disable=console is None):
            found = detect(split.points(frame_id, camera_view=camera_view))
            boxes = found.boxes if level.is_identity else level.inverse.boxes(found.boxes)
            records = records_from(boxes, found.names, found.scores)
            file.write(json_line(f"{frame_id}{split.scan_path(frame_id).suffix}", records, detector=scope))


def read_box_predictions(path: Path, split: LabeledSplit, *, console: Console | None = None) -> BoxFrames:
    """Pair the labels of a split with the predictions of a *.jsonl or *.csv file.

    Boxes are in the scan's own frame, as labels are. `predictions_by_frame` says which frame a line belongs to; lines
    of other frames are left out, and so are boxes where nothing is labelled.

    Args:
        path: the file, or a folder that `asca detect` wrote.
        split: the labels.
        console: shows the progress.

    Raises:
        DatasetError: as `predictions_by_frame`; a prediction without a score.
    """
    path = path / "detections.jsonl" if path.is_dir() else path
    predictions = predictions_by_frame(path, split)
    _require_scores(predictions.values())
    level = split.mounting.level
    frames = []
    for frame_id in track(sorted(predictions), "Points in boxes", console=console, disable=console is None):
        objects, types = split.labeled_boxes(frame_id)
        points = split.points(frame_id, camera_view=False)
        visible = np.asarray(points_in_boxes(points, objects).any(axis=0))
        records = predictions[frame_id].records
        found = records.boxes if level.is_identity else level.boxes(records.boxes)
        kept = np.flatnonzero(_can_be_judged(split, frame_id, objects, found))
        found_types = tuple(records.types[row] for row in kept)
        frames.append(EvaluatedFrame(frame_id, objects, types, visible, found[kept], found_types, records.scores[kept]))
    missing = tuple(frame_id for frame_id in split.frame_ids if frame_id not in predictions)
    return BoxFrames(tuple(frames), missing, stated_scope(path, predictions.values()))


def _can_be_judged(
    split: LabeledSplit, frame_id: str, objects: NDArray[np.float32], found: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Of the boxes (N, 7): which stand where objects are labelled, or so near one of `objects` that it may be meant."""
    apart = np.linalg.norm(found[:, None, :2] - objects[None, :, :2], axis=2)
    return np.asarray(split.in_labeled_view(frame_id, found[:, :3]) | (apart < NEAR_LABEL_M).any(axis=1))


def _require_scores(lines: Iterable[NamedRecords]) -> None:
    for line in lines:
        if np.isnan(line.records.scores).any():
            number = int(np.isnan(line.records.scores).argmax()) + 1
            raise DatasetError(f"{line.place}, box {number}: no `score`; every prediction needs one")
