"""Predictions to be evaluated: KITTI text read with its labels, or written by a detector run over a split.

As in the official tool, the frames with a detection file are evaluated. The others are reported: a frame without
detections needs an empty file.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.files import read_text
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.data.kitti import KittiSplit, in_image, objects_from_boxes, read_labels, write_labels
from asca_pillars.detection.detections import Detections
from asca_pillars.evaluation.kitti.objects import FrameObjects, frame_objects
from asca_pillars.scans.scan_reader import read_scan

KITTI_TYPES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc", "DontCare")
FOLDED_KITTI_TYPES = frozenset(name.casefold() for name in KITTI_TYPES)


@dataclass(frozen=True)
class ScoredFrames:
    """Labels and predictions of the same frames in the same order, and the frames without a prediction file."""

    truth: tuple[FrameObjects, ...]
    detections: tuple[FrameObjects, ...]
    without_predictions: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.truth)

    @property
    def requested(self) -> int:
        """Number of frames that were to be evaluated."""
        return len(self.truth) + len(self.without_predictions)

    @property
    def shortage(self) -> str | None:
        """Sentence to print with every result if not all frames were evaluated; None if all were."""
        return shortage(len(self), self.without_predictions, "no prediction file", "needs an empty file")

    def title_of(self, subject: str) -> str:
        """Return the subject with the number of its frames, or the missing ones."""
        return f"{subject}: {self.shortage or f'{len(self)} frames'}"

    @property
    def foreign_types(self) -> dict[str, tuple[int, int]]:
        """Types that KITTI does not have, as first spelt: the numbers of labels and detections."""
        names: dict[str, str] = {}
        counts = Counter[tuple[str, int]]()
        for side, frames in enumerate((self.truth, self.detections)):
            for name in (name for frame in frames for name in frame.types):
                names.setdefault(name.casefold(), name)
                counts[name.casefold(), side] += 1
        return {
            name: (counts[key, 0], counts[key, 1])
            for key, name in sorted(names.items())
            if key not in FOLDED_KITTI_TYPES
        }


def shortage(evaluated: int, without: Sequence[str], missing: str, remedy: str) -> str | None:
    """Return a sentence about frames without predictions, what they lack, and the remedy.

    None if there is no such frame.
    """
    if not without:
        return None
    first, *others = without
    more = f" and {len(others)} {'other' if len(others) == 1 else 'others'}" if others else ""
    return (
        f"evaluated on {evaluated} of {evaluated + len(without)} frames: {missing} for {first}{more}; "
        f"a frame without detections {remedy}"
    )


def read_truth(folder: str | Path, frame_ids: Sequence[str] | None = None) -> list[FrameObjects]:
    """Read the labels of a folder, those of `frame_ids` or of every file in it, by frame id.

    Raises:
        DatasetError: a missing or empty folder, a missing or damaged file; names file, line, value and remedy.
    """
    chosen = _frame_ids(Path(folder), "labels") if frame_ids is None else sorted(frame_ids)
    return [_read_frame(Path(folder), frame_id, scored=False) for frame_id in chosen]


def read_predictions(
    folder: str | Path, truth: Sequence[FrameObjects], labels: str | Path, *, reporter: Reporter = SILENT
) -> ScoredFrames:
    """Pair the labels with the predictions of a folder of KITTI text, one file per frame.

    Predictions of frames that have labels but are not among `truth` (another split) are left out.

    Args:
        folder: with NAME.txt of 16 fields per line.
        truth: labels of the frames to be evaluated.
        labels: the folder that they are from.
        reporter: for the progress.

    Raises:
        DatasetError: as `read_truth`; a line without a score; a prediction without labels.
    """
    folder, labels = Path(folder), Path(labels)
    predicted_ids = dict.fromkeys(_frame_ids(folder, "predictions"))
    known = {frame.frame_id for frame in truth}
    unlabeled = [name for name in predicted_ids if name not in known and not (labels / f"{name}.txt").is_file()]
    pairs = [frame for frame in truth if frame.frame_id in predicted_ids]
    if not pairs:
        raise DatasetError(
            f"{folder}: none of its {len(predicted_ids)} files is of a frame to be evaluated, as "
            f"{truth[0].frame_id}.txt would be; give files the names of those in {labels}"
        )
    if unlabeled:
        raise DatasetError(
            f"{folder / unlabeled[0]}.txt: a prediction without labels, there is no {labels / unlabeled[0]}.txt "
            f"({len(unlabeled)} such); remove it or add the labels"
        )
    detections = tuple(
        _read_frame(folder, frame.frame_id, scored=True) for frame in reporter.track(pairs, "Reading predictions")
    )
    missing = tuple(frame.frame_id for frame in truth if frame.frame_id not in predicted_ids)
    return ScoredFrames(tuple(pairs), detections, missing)


def write_predictions(
    folder: str | Path,
    split: KittiSplit,
    detect: Callable[[NDArray[np.float32]], Detections],
    *,
    camera_view: bool = True,
    reporter: Reporter = SILENT,
) -> None:
    """Run a detector over a split and write its detections in the image as KITTI text, one file per frame.

    KITTI labels nothing outside the image, so detections there cannot be evaluated and are left out.

    Args:
        folder: folder for NAME.txt of each frame, an empty file without detections.
        split: the frames; their scans and calibrations are read, their labels are not.
        detect: (N, 4) points -> detections, for instance `asca_deploy.Detector` or `models.build.ScanDetector`.
        camera_view: give the detector only the points in the image, as in its training.
        reporter: for the progress.

    Raises:
        DatasetError, ScanError: a frame cannot be read.
    """
    for frame_id in reporter.track(split.frame_ids, "Detecting"):
        calibration, image_size_wh = split.calibration(frame_id), split.image_size_wh(frame_id)
        points = read_scan(split.scan_path(frame_id)).points
        if camera_view:
            points = points[in_image(points, calibration, image_size_wh)]
        detections = detect(points)
        objects = objects_from_boxes(detections.boxes, detections.names, calibration, image_size_wh, detections.scores)
        write_labels(Path(folder) / f"{frame_id}.txt", [item for item in objects if item.bbox[2] > item.bbox[0]])


def _frame_ids(folder: Path, what: str) -> list[str]:
    try:
        names = sorted(path.stem for path in folder.iterdir() if path.suffix == ".txt")
    except OSError as error:
        raise DatasetError(
            f"{folder}: cannot read this folder of {what} ({error.strerror}); correct the path"
        ) from None
    if not names:
        inside = [path.parent.name for path in sorted(folder.glob("*/*.txt"))]
        hint = f"; its folder {inside[0]}/ has some, give that" if inside else "; give the folder with <frame id>.txt"
        raise DatasetError(f"{folder}: no *.txt {what} there{hint}")
    return names


def _read_frame(folder: Path, frame_id: str, *, scored: bool) -> FrameObjects:
    path = folder / f"{frame_id}.txt"
    objects = read_labels(path)
    for index, item in enumerate(objects):
        if scored and item.score is None:
            raise DatasetError(
                f"{_place(path, index)}: 15 fields, but a prediction has 16; append the score at the end of the line"
            )
    return frame_objects(frame_id, objects)


def _place(path: Path, index: int) -> str:
    """Return FILE:LINE of an object: empty lines are not objects."""
    lines = read_text(path, DatasetError, errors="replace").splitlines()
    return f"{path}:{[number for number, line in enumerate(lines, start=1) if line.strip()][index]}"
