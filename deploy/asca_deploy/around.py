"""Every direction with a model that looks ahead: the scan is turned before each pass, and the boxes are turned back.

    pass 0: ahead     pass 1: left     pass 2: behind     pass 3: right

Neighbouring passes both see what stands between them. Of boxes of a class that overlap, the one stays that its pass
sees nearest to straight ahead, where the model has seen the most in training.
"""

import math
from collections.abc import Sequence

import numpy as np

from asca_pillars.geometry.detections import Detections
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.geometry.overlap import rotated_nms
from asca_pillars.geometry.ranges import Ranges

CAMERA_FIELD_RAD = math.pi / 4
"""To each side of a camera's view: KITTI's sees 41 degrees to each side, and a car there is often cut."""
SEAM_MARGIN_RAD = math.radians(10)
"""How far beyond its own sector a pass still reports, for the neighbour may place the center on the other side."""
_HALF_TURN_RAD = math.pi
_STEP_RAD = math.radians(1)


def turns_around(ranges: Ranges, *, camera_view: bool) -> tuple[FrameChange, ...]:
    """What each pass turns the scan by; the first one by nothing.

    As few passes as show every direction, and the margin beside each sector, as far as the model sees ahead or to its
    nearer side, whichever is less, and, for a model trained on a camera's view, within that view. A model that looks
    all around takes one.

    Args:
        ranges: of the model.
        camera_view: whether it was trained on what a camera sees.
    """
    field = CAMERA_FIELD_RAD if camera_view else _HALF_TURN_RAD
    enough_m = min(ranges.x_m[1], -ranges.y_m[0], ranges.y_m[1])
    passes = 1
    while _HALF_TURN_RAD / passes > field + 1e-9 or not _sees(ranges, _HALF_TURN_RAD / passes, enough_m):
        passes += 1
    return tuple(FrameChange.turn(-2 * math.pi * number / passes) for number in range(passes))


def ranges_around(ranges: Ranges, passes: int) -> Ranges:
    """Where the passes look together."""
    if passes == 1:
        return ranges
    reach = max(abs(end) for end in (*ranges.x_m, *ranges.y_m))
    return Ranges((-reach, reach), (-reach, reach), ranges.z_m)


def merge(passes: Sequence[Detections], turns: Sequence[FrameChange], nms_iou: float) -> Detections:
    """The boxes of all passes in the frame before the turns, each object once, best first.

    Args:
        passes: of each turn, in its turned frame; two or more.
        turns: see `turns_around`.
        nms_iou: boxes of a class that overlap more, seen from above, are one object.
    """
    half_sector = _HALF_TURN_RAD / len(passes)
    boxes, scores, labels, off_ahead = [], [], [], []
    for found, turn in zip(passes, turns, strict=True):
        angles = np.abs(np.arctan2(found.boxes[:, 1], found.boxes[:, 0]))
        own = angles <= half_sector + SEAM_MARGIN_RAD
        boxes.append(turn.inverse.boxes(found.boxes[own]))
        scores.append(found.scores[own])
        labels.append(found.labels[own])
        off_ahead.append(angles[own])
    all_boxes, all_scores, all_labels = np.concatenate(boxes), np.concatenate(scores), np.concatenate(labels)
    nearness = -np.concatenate(off_ahead)
    kept = []
    for label in np.unique(all_labels):
        same = np.flatnonzero(all_labels == label)
        kept.append(same[rotated_nms(all_boxes[same], nearness[same], nms_iou)])
    survivors = np.concatenate([np.empty(0, np.int64), *kept])
    best = survivors[np.argsort(-all_scores[survivors], kind="stable")]
    return Detections(
        all_boxes[best],
        all_scores[best],
        all_labels[best],
        passes[0].class_names,
        non_finite=sum(found.non_finite for found in passes),
    )


def _sees(ranges: Ranges, half_sector_rad: float, distance_m: float) -> bool:
    """Whether a model sees so far in every direction of the sector around straight ahead, and of its margins."""
    angles = np.arange(0, min(half_sector_rad + SEAM_MARGIN_RAD, _HALF_TURN_RAD), _STEP_RAD)
    x, y = distance_m * np.cos(angles), distance_m * np.sin(angles)
    (x_min, x_max), (y_min, y_max) = ranges.x_m, ranges.y_m
    # What is nearer than a range that begins ahead of the sensor, no pass sees.
    inside = (x >= min(x_min, 0.0)) & (x <= x_max) & (y <= y_max) & (-y >= y_min)
    return bool(inside.all())
