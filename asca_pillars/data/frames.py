"""Labelled frames: points with the boxes and classes that a detector is to find in them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.kitti import KittiSplit, boxes_from_objects, in_image
from asca_pillars.data.scans.scan_reader import read_scan
from asca_pillars.errors import DatasetError
from asca_pillars.geometry.anchors import IGNORED
from asca_pillars.geometry.boxes import points_in_boxes
from asca_pillars.geometry.ranges import Ranges

# What KITTI's protocol treats as neither right nor wrong for a class.
NEIGHBOR_TYPES = {"Car": "Van", "Pedestrian": "Person_sitting"}


class Motion(NamedTuple):
    """How augmentation moved a scene as a whole, in this order: mirrored about the x axis, turned, scaled, raised."""

    flipped: bool = False
    rotation_rad: float = 0.0
    scale: float = 1.0
    shift_z_m: float = 0.0


UNMOVED = Motion()


@dataclass(frozen=True)
class LabeledFrame:
    """One frame with its labels.

    Attributes:
        frame_id: name of the frame in its dataset.
        points: (N, 4) float32 x, y, z, reflectance.
        boxes: (M, 7) float32.
        labels: (M,) int64 class index, or IGNORED.
        motion: of the scene since it was read from its file.
    """

    frame_id: str
    points: NDArray[np.float32]
    boxes: NDArray[np.float32]
    labels: NDArray[np.int64]
    motion: Motion = UNMOVED


def read_frame(
    split: KittiSplit, frame_id: str, class_names: Sequence[str], *, camera_view: bool = True, min_points: int = 1
) -> LabeledFrame:
    """Points and labelled boxes of one frame.

    Objects of other types are left out; neighbours of a class (KITTI's Van for Car) and objects with too few points
    become IGNORED.

    Args:
        split: the dataset.
        frame_id: one of `split.frame_ids`.
        class_names: types that become labels 0, 1, ...
        camera_view: keep only the points that the camera sees; KITTI labels nothing else.
        min_points: an object with fewer points inside its box is IGNORED.

    Raises:
        DatasetError: a missing or damaged file, or an object of a class without a 3D box.
    """
    points = read_points(split, frame_id, camera_view=camera_view)
    known = {NEIGHBOR_TYPES[name]: IGNORED for name in class_names if name in NEIGHBOR_TYPES}
    known |= {name: index for index, name in enumerate(class_names)}
    objects = [item for item in split.objects(frame_id) if item.type in known]
    if flat := [item.type for item in objects if not item.has_box_3d]:
        raise DatasetError(
            f"{split.label_path(frame_id)}: a {flat[0]} has no 3D box, its sizes are not all positive; "
            "complete the line, or make it DontCare"
        )
    boxes = boxes_from_objects(objects, split.calibration(frame_id))
    labels = np.array([known[item.type] for item in objects], dtype=np.int64)
    labels[points_in_boxes(points, boxes).sum(axis=0) < min_points] = IGNORED
    return LabeledFrame(frame_id, points, boxes, labels)


def read_points(split: KittiSplit, frame_id: str, *, camera_view: bool) -> NDArray[np.float32]:
    """Points (N, 4) of one frame, all of them or those that the camera sees.

    Raises:
        DatasetError, ScanError: a missing or damaged file.
    """
    points = read_scan(split.scan_path(frame_id)).points
    if camera_view:
        points = points[in_image(points, split.calibration(frame_id), split.image_size_wh(frame_id))]
    return points


def within_ranges(frame: LabeledFrame, ranges: Ranges) -> LabeledFrame:
    """The frame without the boxes whose center lies outside `ranges`: no anchor stands where they are."""
    inside = ranges.hold_centers(frame.boxes)
    return replace(frame, boxes=frame.boxes[inside], labels=frame.labels[inside])
