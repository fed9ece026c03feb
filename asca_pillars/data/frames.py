"""Labelled frames: points with their ground-truth boxes and classes."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.labeled_split import LabeledSplit
from asca_pillars.detection.anchors import IGNORED
from asca_pillars.geometry.boxes import points_in_boxes
from asca_pillars.geometry.ranges import Ranges

# Types that KITTI's evaluation counts neither as true nor as false positives of a class.
NEIGHBOR_TYPES = {"Car": "Van", "Pedestrian": "Person_sitting"}


def other_spelling(name: str, types: Iterable[str]) -> str | None:
    """Return the one of `types` that differs from `name` in case, blanks or punctuation alone, or None."""
    return next((kind for kind in types if kind != name and _letters(kind) == _letters(name)), None)


def _letters(name: str) -> str:
    return "".join(letter for letter in name.casefold() if letter.isalnum())


class Motion(NamedTuple):
    """Global augmentation of a scene, in this order: flip about the x axis, rotation, scaling, height shift."""

    flipped: bool = False
    rotation_rad: float = 0.0
    scale: float = 1.0
    shift_z_m: float = 0.0


UNMOVED = Motion()


@dataclass(frozen=True)
class LabeledFrame:
    """Frame with its labels.

    Attributes:
        frame_id: name of the frame in its dataset.
        points: (N, 4) float32 x, y, z, reflectance.
        boxes: (M, 7) float32.
        labels: (M,) int64 class index, or IGNORED.
        motion: global augmentation applied so far.
    """

    frame_id: str
    points: NDArray[np.float32]
    boxes: NDArray[np.float32]
    labels: NDArray[np.int64]
    motion: Motion = UNMOVED


def read_frame(
    split: LabeledSplit, frame_id: str, class_names: Sequence[str], *, camera_view: bool = True, min_points: int = 1
) -> LabeledFrame:
    """Read points and labelled boxes of one frame.

    Objects of other types are left out; neighbors of a class (KITTI's Van for Car) and objects with too few points
    become IGNORED.

    Args:
        split: the dataset.
        frame_id: one of `split.frame_ids`.
        class_names: types that become labels 0, 1, ...
        camera_view: keep only the points within the camera image; KITTI labels nothing else.
        min_points: an object with fewer points inside its box is IGNORED.

    Raises:
        DatasetError: a missing or damaged file, or an object of a class without a 3D box.
    """
    points = split.points(frame_id, camera_view=camera_view)
    known = {NEIGHBOR_TYPES[name]: IGNORED for name in class_names if name in NEIGHBOR_TYPES}
    known |= {name: index for index, name in enumerate(class_names)}
    boxes, types = split.labeled_boxes(frame_id, known)
    labels = np.array([known[kind] for kind in types], dtype=np.int64)
    if min_points:
        labels[points_in_boxes(points, boxes).sum(axis=0) < min_points] = IGNORED
    return LabeledFrame(frame_id, points, boxes, labels)


def within_ranges(frame: LabeledFrame, ranges: Ranges) -> LabeledFrame:
    """Return the frame without the boxes whose center is outside `ranges`, where there are no anchors."""
    inside = ranges.hold_centers(frame.boxes)
    return replace(frame, boxes=frame.boxes[inside], labels=frame.labels[inside])
