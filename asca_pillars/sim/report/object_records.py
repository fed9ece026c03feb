"""What the returns of labelled objects look like, one record per object: the raw material of `look_alikes`."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.kitti import KittiObject
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.boxes import points_in_boxes, wrap_angle
from asca_pillars.geometry.overlap import bev_iou
from asca_pillars.sim.report.reference import CLASSES

BRIGHT = 0.5  # reflectance from which on a return is bright: plates, lamps, reflectors, pale paint
PILLAR_M = 0.16
LOWEST, WHEELS, MIDDLE = (0.0, 0.12), (0.12, 0.30), (0.50, 0.70)  # zones, in shares of the box's height
SCORED_IOU = 0.25  # BEV IoU from which on a detection of the class is one of the object

_Points = NDArray[np.float32]


class ObjectRecord(NamedTuple):
    """A labelled object and its returns.

    Attributes:
        class_name: one of CLASSES.
        distance_m: horizontal, from the sensor.
        view_deg: 0..90 between the heading and the line of sight; 90 is seen from the side.
        occluded: KITTI's state, 0..3.
        points: returns in the box, at least 1.
        lowest, wheels, middle: shares of them in the zones LOWEST, WHEELS and MIDDLE of the height.
        length_m: how much of the box's length they cover.
        bright: share of them with a reflectance of BRIGHT or more.
        pillars: cells of PILLAR_M that hold one.
        score: of the best detection of its class there; 0 for none, NaN without a detector.
    """

    class_name: str
    distance_m: float
    view_deg: float
    occluded: int
    points: float
    lowest: float
    wheels: float
    middle: float
    length_m: float
    bright: float
    pillars: float
    score: float


def record_objects(
    points: _Points, objects: Sequence[KittiObject], boxes: NDArray[np.float32], found: Detections | None
) -> list[ObjectRecord]:
    """Records of the objects of CLASSES that have returns.

    Args:
        points: (N, 4) of the scan, LiDAR frame.
        objects: M labels with a 3D box.
        boxes: (M, 7) of these, LiDAR frame.
        found: what a detector finds in the scan, if one was asked.
    """
    inside = points_in_boxes(points, boxes)
    return [
        _record(item.type, item.occluded, box, points[mask], found)
        for item, box, mask in zip(objects, boxes.astype(np.float64), inside.T, strict=True)
        if item.type in CLASSES and mask.any()
    ]


def seen_objects(objects: Sequence[KittiObject]) -> list[KittiObject]:
    """Those with a 3D box that the image shows."""
    return [item for item in objects if item.has_box_3d and item.bbox[2] > item.bbox[0]]


def _record(
    name: str, occluded: int, box: NDArray[np.float64], points: _Points, found: Detections | None
) -> ObjectRecord:
    x, y, z, _, _, height, yaw = box
    aside = abs(float(wrap_angle(yaw - np.arctan2(y, x))))
    up = (points[:, 2] - (z - height / 2)) / height
    along = (points[:, 0] - x) * np.cos(yaw) + (points[:, 1] - y) * np.sin(yaw)
    cells = np.unique(np.floor(points[:, :2] / PILLAR_M).astype(np.int64), axis=0)
    lowest, wheels, middle = (float(np.mean((up >= low) & (up < high))) for low, high in (LOWEST, WHEELS, MIDDLE))
    return ObjectRecord(
        class_name=name,
        distance_m=float(np.hypot(x, y)),
        view_deg=float(np.rad2deg(min(aside, np.pi - aside))),
        occluded=max(occluded, 0),
        points=float(len(points)),
        lowest=lowest,
        wheels=wheels,
        middle=middle,
        length_m=float(np.ptp(along)),
        bright=float(np.mean(points[:, 3] >= BRIGHT)),
        pillars=float(len(cells)),
        score=float("nan") if found is None else _score(name, box, found),
    )


def _score(name: str, box: NDArray[np.float64], found: Detections) -> float:
    of_class = found[np.array([other == name for other in found.names], bool)]
    if not len(of_class):
        return 0.0
    overlap = bev_iou(box[None].astype(np.float32), of_class.boxes)[0]
    return float(np.max(of_class.scores * (overlap >= SCORED_IOU), initial=0.0))
