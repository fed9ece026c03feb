"""Frames for the error analysis: points, labels and detections of one frame, the sensor at the origin."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.frames import LabeledSplit
from asca_pillars.data.kitti import KittiSplit, boxes_from_objects, read_labels
from asca_pillars.evaluation.boxes.box_pairs import EvaluatedFrame
from asca_pillars.evaluation.kitti.objects import (
    FrameObjects,
    Frames,
    KittiState,
    detection_states,
    dont_care_shares,
    frame_objects,
    truth_states,
)
from asca_pillars.evaluation.kitti.score_threshold import DONT_CARE_SHARE
from asca_pillars.evaluation.predictions import KITTI_TYPES
from asca_pillars.geometry.boxes import points_in_boxes

UNKNOWN_OCCLUSION = -1
DIFFICULTY = "moderate"


@dataclass(frozen=True, eq=False)
class ErrorFrame:
    """Frame with its labels and detections. Metres and radians, LiDAR frame translated to the sensor.

    Attributes:
        frame_id: name of the frame in its dataset.
        points: (N, 4) x, y, z, reflectance; with a camera those in the image.
        objects: (M, 7) labelled boxes of every type.
        types: types of the objects.
        occluded: (M,) KITTI's 0 to 3, or UNKNOWN_OCCLUSION.
        truncated: (M,) 0..1, 0 where unknown.
        object_points: (M,) points in each box.
        counted: (M,) objects that are counted: within the protocol's limits and with a point inside.
        detections: (D, 7) detected boxes.
        detection_types: types of the detections.
        scores: (D,).
        ignored: (D,) detections that are never false: in a DontCare area, or below KITTI's minimum height in the image.
    """

    frame_id: str
    points: NDArray[np.float32]
    objects: NDArray[np.float64]
    types: tuple[str, ...]
    occluded: NDArray[np.int64]
    truncated: NDArray[np.float64]
    object_points: NDArray[np.int64]
    counted: NDArray[np.bool_]
    detections: NDArray[np.float64]
    detection_types: tuple[str, ...]
    scores: NDArray[np.float64]
    ignored: NDArray[np.bool_]


class ErrorFrames(Protocol):
    """Frames of an evaluation, read one by one, since the points of a thousand scans may exceed the memory."""

    @property
    def frame_ids(self) -> Sequence[str]:
        """Sorted frame ids."""

    def read(self, frame_id: str) -> ErrorFrame:
        """Read one frame; DatasetError or ScanError if a file of it is missing or damaged."""


@dataclass(frozen=True)
class KittiErrorFrames:
    """Frames of KITTI's layout with predictions as KITTI text; objects are counted within the limits of moderate.

    Attributes:
        split: scans and calibrations.
        labels, predictions: folders of the text.
        class_names: evaluated classes.
        frame_ids: ids of the frames with predictions, sorted.
    """

    split: KittiSplit
    labels: Path
    predictions: Path
    class_names: tuple[str, ...]
    frame_ids: tuple[str, ...]

    def read(self, frame_id: str) -> ErrorFrame:
        """Read one frame; types are spelt as in KITTI and `class_names`."""
        calibration = self.split.calibration(frame_id)
        labelled = read_labels(self.labels / f"{frame_id}.txt")
        truth = [item for item in labelled if item.has_box_3d]
        detections = [item for item in read_labels(self.predictions / f"{frame_id}.txt") if item.has_box_3d]
        points = self.split.points(frame_id, camera_view=True)
        boxes = boxes_from_objects(truth, calibration).astype(np.float64)
        inside = points_in_boxes(points, boxes).sum(axis=0)
        flat_truth, flat_found = frame_objects(frame_id, truth), frame_objects(frame_id, detections)
        flat_areas = frame_objects(frame_id, [item for item in labelled if not item.has_box_3d])
        return ErrorFrame(
            frame_id=frame_id,
            points=points,
            objects=boxes,
            types=tuple(self._spelling.get(item.type.casefold(), item.type) for item in truth),
            occluded=flat_truth.occluded.astype(np.int64),
            truncated=np.maximum(flat_truth.truncated, 0.0),
            object_points=inside,
            counted=_counted(flat_truth, self.class_names) & (inside > 0),
            detections=boxes_from_objects(detections, calibration).astype(np.float64),
            detection_types=tuple(self._spelling.get(item.type.casefold(), item.type) for item in detections),
            scores=flat_found.scores,
            ignored=_ignored(flat_found, flat_areas),
        )

    @cached_property
    def _spelling(self) -> dict[str, str]:
        return {name.casefold(): name for name in (*KITTI_TYPES, *self.class_names)}


@dataclass(frozen=True)
class BoxErrorFrames:
    """Frames of any layout with boxes in the LiDAR frame; objects with a point are counted.

    Attributes:
        split: the scans.
        frames: labels and predictions, in the frame of `split.points`.
    """

    split: LabeledSplit
    frames: tuple[EvaluatedFrame, ...]

    @cached_property
    def frame_ids(self) -> tuple[str, ...]:
        """Ids of the frames with predictions, sorted."""
        return tuple(sorted(self._by_id))

    def read(self, frame_id: str) -> ErrorFrame:
        """Read one frame; occlusion is unknown."""
        frame, change = self._by_id[frame_id], self.split.to_sensor
        points = change.points(self.split.points(frame_id, camera_view=False))
        objects = change.boxes(np.asarray(frame.objects)).astype(np.float64)
        inside = points_in_boxes(points, objects).sum(axis=0)
        return ErrorFrame(
            frame_id=frame_id,
            points=points,
            objects=objects,
            types=tuple(frame.object_types),
            occluded=np.full(len(objects), UNKNOWN_OCCLUSION),
            truncated=np.zeros(len(objects)),
            object_points=inside,
            counted=inside > 0,
            detections=change.boxes(np.asarray(frame.detections)).astype(np.float64),
            detection_types=tuple(frame.detection_types),
            scores=np.asarray(frame.scores, np.float64),
            ignored=np.zeros(len(frame.detections), bool),
        )

    @cached_property
    def _by_id(self) -> dict[str, EvaluatedFrame]:
        return {frame.frame_id: frame for frame in self.frames}


def _counted(truth: FrameObjects, class_names: Sequence[str]) -> NDArray[np.bool_]:
    counted = np.zeros(len(truth), bool)
    for name in class_names:
        counted |= truth_states(truth, name, DIFFICULTY) == KittiState.COUNTED
    return counted


def _ignored(detections: FrameObjects, areas: FrameObjects) -> NDArray[np.bool_]:
    low = detection_states(detections, "", DIFFICULTY) == KittiState.IGNORED  # too low for any class
    return np.asarray(low | (dont_care_shares(Frames.join([areas], [detections])) > DONT_CARE_SHARE))
