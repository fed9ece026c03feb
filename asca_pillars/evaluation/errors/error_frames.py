"""Frames as the error analysis takes them: points, labels and detections of one frame, the sensor at the origin."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.kitti import KittiSplit, boxes_from_objects, read_labels
from asca_pillars.data.labeled_split import LabeledSplit
from asca_pillars.evaluation.boxes.box_predictions import BoxFrames
from asca_pillars.evaluation.kitti.objects import FrameObjects, frame_objects
from asca_pillars.evaluation.kitti.pairs import Frames, dont_care_shares
from asca_pillars.evaluation.kitti.score_threshold import DONT_CARE_SHARE
from asca_pillars.evaluation.kitti.states import KittiState, detection_states, truth_states
from asca_pillars.evaluation.predictions import KITTI_TYPES, ScoredFrames
from asca_pillars.geometry.boxes import points_in_boxes

UNKNOWN_OCCLUSION = -1
_DIFFICULTY = "moderate"


@dataclass(frozen=True, eq=False)
class ErrorFrame:
    """One frame with its labels and detections. Metres and radians, LiDAR frame moved to the sensor.

    Attributes:
        frame_id: name of the frame in its dataset.
        points: (N, 4) x, y, z, reflectance; with a camera those in the image.
        objects: (M, 7) labelled boxes of every type.
        types: of the objects.
        occluded: (M,) KITTI's 0 to 3, or UNKNOWN_OCCLUSION.
        truncated: (M,) 0..1, 0 where unknown.
        object_points: (M,) points in each box.
        counted: (M,) objects that are to be found: within the protocol's limits and with a point inside.
        found: (D,) detected boxes.
        found_types: of the detections.
        scores: (D,).
        excused: (D,) detections that are no error wherever they stand: in a DontCare area, or smaller in the image than
            KITTI labels.
    """

    frame_id: str
    points: NDArray[np.float32]
    objects: NDArray[np.float64]
    types: tuple[str, ...]
    occluded: NDArray[np.int64]
    truncated: NDArray[np.float64]
    object_points: NDArray[np.int64]
    counted: NDArray[np.bool_]
    found: NDArray[np.float64]
    found_types: tuple[str, ...]
    scores: NDArray[np.float64]
    excused: NDArray[np.bool_]


def kitti_error_frames(
    split: KittiSplit, labels: Path, predictions: Path, scored: ScoredFrames, class_names: Sequence[str]
) -> Iterator[ErrorFrame]:
    """Frames of KITTI's layout with predictions as KITTI text; objects count within the limits of moderate.

    Args:
        split: the scans and calibrations.
        labels, predictions: folders of the text.
        scored: which frames have predictions.
        class_names: classes that are evaluated.

    Raises:
        DatasetError, ScanError: a file is missing or damaged.
    """
    known = {name.casefold(): name for name in (*KITTI_TYPES, *class_names)}
    for frame in scored.truth:
        frame_id = frame.frame_id
        calibration = split.calibration(frame_id)
        truth = [item for item in read_labels(labels / f"{frame_id}.txt") if item.has_box_3d]
        areas = [item for item in read_labels(labels / f"{frame_id}.txt") if not item.has_box_3d]
        found = [item for item in read_labels(predictions / f"{frame_id}.txt") if item.has_box_3d]
        points = split.points(frame_id, camera_view=True)
        boxes = boxes_from_objects(truth, calibration).astype(np.float64)
        inside = points_in_boxes(points, boxes).sum(axis=0)
        flat_truth, flat_found = frame_objects(frame_id, truth), frame_objects(frame_id, found)
        yield ErrorFrame(
            frame_id,
            points,
            boxes,
            tuple(known.get(item.type.casefold(), item.type) for item in truth),
            flat_truth.occluded.astype(np.int64),
            flat_truth.truncated,
            inside,
            _counted(flat_truth, class_names) & (inside > 0),
            boxes_from_objects(found, calibration).astype(np.float64),
            tuple(known.get(item.type.casefold(), item.type) for item in found),
            flat_found.scores,
            _excused(flat_found, frame_objects(frame_id, areas)),
        )


def box_error_frames(split: LabeledSplit, scored: BoxFrames) -> Iterator[ErrorFrame]:
    """Frames of any layout with boxes in the LiDAR frame; an object counts if it holds a point.

    Raises:
        ScanError: a scan is missing or damaged.
    """
    change = split.to_sensor
    for frame in scored.frames:
        points = change.points(split.points(frame.frame_id, camera_view=False))
        objects = change.boxes(np.asarray(frame.objects)).astype(np.float64)
        inside = points_in_boxes(points, objects).sum(axis=0)
        yield ErrorFrame(
            frame.frame_id,
            points,
            objects,
            tuple(frame.object_types),
            np.full(len(objects), UNKNOWN_OCCLUSION),
            np.zeros(len(objects)),
            inside,
            inside > 0,
            change.boxes(np.asarray(frame.found)).astype(np.float64),
            tuple(frame.found_types),
            np.asarray(frame.scores, np.float64),
            np.zeros(len(frame.found), bool),
        )


def _counted(truth: FrameObjects, class_names: Sequence[str]) -> NDArray[np.bool_]:
    counted = np.zeros(len(truth), bool)
    for name in class_names:
        counted |= truth_states(truth, name, _DIFFICULTY) == KittiState.COUNTED
    return counted


def _excused(found: FrameObjects, areas: FrameObjects) -> NDArray[np.bool_]:
    low = detection_states(found, "", _DIFFICULTY) == KittiState.IGNORED
    return np.asarray(low | (dont_care_shares(Frames.join([areas], [found])) > DONT_CARE_SHARE))
