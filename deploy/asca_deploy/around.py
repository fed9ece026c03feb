"""Detection in every direction with a model that looks ahead: one pass with wider ranges, or several turned ones.

A sparse neck's graphs hold no ranges, so that a bundle trained on whole revolutions is run with wider ones
(`widen_ranges`). With others the scan is turned before each pass, and the boxes are turned back:

    pass 0: ahead     pass 1: left     pass 2: behind     pass 3: right

The scan turns about the normal of its ground. With a sensor pitched by half a degree the road ahead rises, as in the
training data; turned about the sensor's axis, the road behind would sink, and fewer objects would be found.

Objects between two sectors are found by both passes. Of overlapping boxes of a class, that one is kept which is nearest
to straight ahead in its pass, where the model had the most training data.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from asca_deploy.bundle import Bundle, PillarBundle
from asca_pillars.base.errors import ConfigError
from asca_pillars.detection.decode import nms_by_class
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.boxes import Ranges
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.ops.pillar.grid import NECK_STRIDE
from asca_pillars.scans.ground_height import fit_ground_plane

CAMERA_FIELD_RAD = math.pi / 4
"""Half the assumed field of view of a camera: KITTI's sees 41 degrees to each side, and a car there is often cut."""
SEAM_MARGIN_RAD = math.radians(10)
"""Margin beside a pass's sector in which it still reports boxes: the next pass may place the center differently."""
GROUND_POINTS = 10_000
"""Points of a scan that its ground is fitted to: the normal then differs by some hundredths of a degree."""
_HALF_TURN_RAD = math.pi
_STEP_RAD = math.radians(1)


def widen_ranges(bundle: Bundle) -> Bundle:
    """Return the bundle with ranges widened in every direction to its farthest reach, where its graphs allow it.

    That requires a sparse neck, which reads rulebooks instead of a map, pillars of one size, and weights trained on
    whole revolutions. Other bundles are returned unchanged. A second stage gets as many times the proposals and
    keypoints as there would be turned passes.
    """
    if not isinstance(bundle, PillarBundle) or bundle.pillar.neck == "dense" or bundle.expected_input.camera_view:
        return bundle
    spec, grid = bundle.spec, bundle.spec.grid
    if grid.zones > 1 or spec.anchor_places != "cells":
        return bundle
    reach = max(abs(end) for end in (*grid.x_range_m, *grid.y_range_m))
    x_end, y_end = (_fitting_range(reach, pillar_m) for pillar_m in (grid.v_max_m, grid.v_y_m))
    refine = bundle.refine
    if refine is not None:
        passes = len(turns_around(spec.ranges, camera_view=False))
        refine = replace(refine, seen=refine.seen.scaled(passes))
    return replace(bundle, spec=spec.with_ranges((-x_end, x_end), (-y_end, y_end)), refine=refine)


def _fitting_range(reach_m: float, pillar_m: float) -> float:
    """Return the shortest range from `reach_m` on that holds whole pillars and fits the network's strides."""
    step_m = NECK_STRIDE * pillar_m
    return round(math.ceil(reach_m / step_m - 1e-6) * step_m, 6)


def turns_around(ranges: Ranges, *, camera_view: bool) -> tuple[FrameChange, ...]:
    """Return the turn of the scan for each pass; the first one is the identity.

    There are as few passes as cover every direction, and the margin beside each sector, as far as the model sees
    ahead or to its nearer side, whichever is less, and, for a model trained on a camera's view, within that view. A
    model that looks all around takes one.

    Args:
        ranges: of the model.
        camera_view: whether it was trained on what a camera sees.

    Raises:
        ConfigError: the model does not see straight ahead and to both sides, so no turns show every direction.
    """
    field = CAMERA_FIELD_RAD if camera_view else _HALF_TURN_RAD
    enough_m = min(ranges.x_m[1], -ranges.y_m[0], ranges.y_m[1])
    if enough_m <= 0:
        (x_min, x_max), (y_min, y_max) = ranges.x_m, ranges.y_m
        raise ConfigError(
            f"view around: the model looks from x {x_min:g} to {x_max:g} m and from y {y_min:g} to {y_max:g} m, and "
            "turning needs one that sees ahead and to both sides; choose view ahead"
        )
    passes = 1
    while _HALF_TURN_RAD / passes > field + 1e-9 or not _sees(ranges, _HALF_TURN_RAD / passes, enough_m):
        passes += 1
    return tuple(FrameChange.turn(-2 * math.pi * number / passes) for number in range(passes))


def about_ground(turns: Sequence[FrameChange], points: NDArray[np.float32]) -> tuple[FrameChange, ...]:
    """Return the turns about the normal of a scan's ground, through its origin; about z where no ground is found.

    The ground keeps its pose in all of them. The first turn, the identity, is not changed.

    Args:
        turns: see `turns_around`.
        points: (N, >=3) of the scan, metres, model's frame.
    """
    plane = fit_ground_plane(points[:: max(1, len(points) // GROUND_POINTS)])
    if plane is None or plane.doubt is not None:
        return tuple(turns)
    up = np.array(plane.normal)
    forward = np.array([1.0, 0.0, 0.0]) - up[0] * up
    forward /= np.linalg.norm(forward)
    level = np.stack([forward, np.cross(up, forward), up])
    return tuple(turn if turn.is_identity else FrameChange(level.T @ turn.axes @ level, turn.shift_m) for turn in turns)


def ranges_around(ranges: Ranges, passes: int) -> Ranges:
    """Return the ranges that the passes cover together."""
    if passes == 1:
        return ranges
    reach = max(abs(end) for end in (*ranges.x_m, *ranges.y_m))
    return Ranges((-reach, reach), (-reach, reach), ranges.z_m)


def without_own_vehicle(detections: Detections) -> Detections:
    """Return the boxes that the sensor is not in; one that it is in, seen from above, is the vehicle that carries it.

    KITTI's sensor sees nothing of its car, and the simulated one neither. Others see its roof or bonnet, which a model
    takes for another car.

    Args:
        detections: in the model's frame, whose z axis leads through the sensor or the vehicle.
    """
    x, y, _, length, width, _, yaw = detections.boxes.astype(np.float64).T
    along, across = x * np.cos(yaw) + y * np.sin(yaw), y * np.cos(yaw) - x * np.sin(yaw)
    return detections[(np.abs(along) > length / 2) | (np.abs(across) > width / 2)]


def merge(passes: Sequence[Detections], turns: Sequence[FrameChange], nms_iou: float) -> Detections:
    """Return the boxes of all passes in the frame before the turns, each object once, best first.

    Args:
        passes: of each turn, in its turned frame; two or more.
        turns: see `turns_around`.
        nms_iou: BEV IoU of two boxes of a class above which they are one object.
    """
    half_sector = _HALF_TURN_RAD / len(passes)
    boxes, scores, labels, off_ahead = [], [], [], []
    for detections, turn in zip(passes, turns, strict=True):
        angles = np.abs(np.arctan2(detections.boxes[:, 1], detections.boxes[:, 0]))
        in_sector = angles <= half_sector + SEAM_MARGIN_RAD
        boxes.append(turn.inverse.boxes(detections.boxes[in_sector]))
        scores.append(detections.scores[in_sector])
        labels.append(detections.labels[in_sector])
        off_ahead.append(angles[in_sector])
    all_boxes, all_scores, all_labels = np.concatenate(boxes), np.concatenate(scores), np.concatenate(labels)
    nearness = -np.concatenate(off_ahead)
    survivors = nms_by_class(all_boxes, nearness, all_labels, nms_iou)
    best = survivors[np.argsort(-all_scores[survivors], kind="stable")]
    return Detections(
        all_boxes[best],
        all_scores[best],
        all_labels[best],
        passes[0].class_names,
        non_finite=sum(detections.non_finite for detections in passes),
    )


def _sees(ranges: Ranges, half_sector_rad: float, distance_m: float) -> bool:
    """Return whether a model sees to `distance_m` in every direction of the sector ahead and of its margins."""
    angles = np.arange(0, min(half_sector_rad + SEAM_MARGIN_RAD, _HALF_TURN_RAD), _STEP_RAD)
    x, y = distance_m * np.cos(angles), distance_m * np.sin(angles)
    (x_min, x_max), (y_min, y_max) = ranges.x_m, ranges.y_m
    # No pass covers the space nearer than a range that begins ahead of the sensor.
    inside = (x >= min(x_min, 0.0)) & (x <= x_max) & (y <= y_max) & (-y >= y_min)
    return bool(inside.all())
