"""KITTI text as what Waymo's metric takes: boxes, difficulty levels from the points in them, no-label zones.

Frame: at the camera, x forward, y left, z up, metres. Distances are from the camera, as in KITTI's protocol.

- The level of an object comes from the number of LiDAR points in its box. Without scans every object is LEVEL_2.
- A class may have any name. KITTI's other types, such as Truck, are evaluated only if a detection names them.
- KITTI labels no no-label zones. In their place stand DontCare areas that hold more than half of a detection's 2D box,
  and objects of a neighboring type (Van for Car, Person_sitting for Pedestrian) that it overlaps enough to match.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from asca_pillars.base.errors import DatasetError
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.detection.detections import Detections
from asca_pillars.evaluation.kitti.average_precision import CLASS_NAMES
from asca_pillars.evaluation.kitti.objects import FrameObjects
from asca_pillars.evaluation.kitti.pairs import Frames, dont_care_shares
from asca_pillars.evaluation.kitti.score_threshold import DONT_CARE_SHARE
from asca_pillars.evaluation.kitti.states import is_neighbor
from asca_pillars.evaluation.predictions import FOLDED_KITTI_TYPES, ScoredFrames
from asca_pillars.evaluation.waymo import WaymoTruth, difficulty_levels, min_iou
from asca_pillars.geometry.boxes import points_in_boxes, wrap_angle
from asca_pillars.geometry.overlap import iou_3d
from asca_pillars.scans.scan_reader import read_scan

_LEVEL_2 = 2


class WaymoFrames(NamedTuple):
    """The arguments of `waymo_detection`: labels, detections and no-label zones of the same frames."""

    truth: list[WaymoTruth]
    detections: list[Detections]
    no_label: list[NDArray[np.bool_]]


def evaluated_classes(frames: ScoredFrames) -> tuple[str, ...]:
    """KITTI's classes that occur, then the other ones that detections name or that KITTI does not know."""
    labelled = {name.casefold(): name for frame in frames.truth for name in frame.types}
    detected = {name.casefold(): name for frame in frames.detections for name in frame.types}
    named = detected | labelled  # the spelling of the labels wins
    official = [name for name in CLASS_NAMES if name.casefold() in named]
    others = [key for key in named if key in detected or key not in FOLDED_KITTI_TYPES]
    folded = {name.casefold() for name in (*CLASS_NAMES, "DontCare")}
    return (*official, *sorted(named[key] for key in others if key not in folded))


def waymo_frames(
    frames: ScoredFrames, class_names: Sequence[str], split: KittiSplit | None, *, console: Console | None = None
) -> WaymoFrames:
    """Labels and detections of KITTI text in one upright frame, with levels and no-label zones.

    Args:
        frames: labels and predictions.
        class_names: what is evaluated.
        split: where the scans and calibrations are; None if there are none.
        console: shows the progress.

    Raises:
        DatasetError, ScanError: a score outside [0, 1]; a scan or calibration that cannot be read.
    """
    result = WaymoFrames([], [], [])
    pairs = list(zip(frames.truth, frames.detections, strict=True))
    for truth, found in track(pairs, "Points in boxes", console=console, disable=console is None or split is None):
        detections, no_label = _detections(truth, found, tuple(class_names))
        result.truth.append(_truth(truth, class_names, split))
        result.detections.append(detections)
        result.no_label.append(no_label)
    return result


def upright_boxes(objects: FrameObjects) -> NDArray[np.float64]:
    """(N, 7) x, y, z of the center, length, width, height, yaw; metres and radians, x forward, y left, z up."""
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
    truth: FrameObjects, found: FrameObjects, class_names: tuple[str, ...]
) -> tuple[Detections, NDArray[np.bool_]]:
    """Those of the classes, D of them, and which (D,) lie in what stands for a no-label zone."""
    labels = _labels(found, class_names)
    known = labels >= 0
    wrong = found.scores[known & ((found.scores < 0) | (found.scores > 1))]
    if len(wrong):
        raise DatasetError(
            f"frame {found.frame_id}: score {wrong[0]:g}; Waymo's metric cuts off at 0, 0.01 .. 1: "
            "scale the scores of the predictions to [0, 1]"
        )
    boxes, scores = upright_boxes(found)[known].astype(np.float32), found.scores[known].astype(np.float32)
    zones = dont_care_shares(Frames.join([truth], [found]))[known] > DONT_CARE_SHARE
    for label, name in enumerate(class_names):
        own = labels[known] == label
        neighbors = is_neighbor(truth, name) & (_labels(truth, class_names) < 0)
        zones[own] |= np.any(iou_3d(boxes[own], upright_boxes(truth)[neighbors]) >= min_iou(name), axis=1)
    return Detections(boxes, scores, labels[known], class_names), zones


def _labels(objects: FrameObjects, class_names: Sequence[str]) -> NDArray[np.int64]:
    """(N,) index of each object's class; -1 for another type, and for an object without a 3D box."""
    index = {name.casefold(): label for label, name in enumerate(class_names)}
    labels = np.array([index.get(name, -1) for name in objects.folded_types.tolist()], dtype=np.int64)
    return np.where(objects.dimensions_hwl.min(axis=1, initial=np.inf) > 0, labels, -1)
