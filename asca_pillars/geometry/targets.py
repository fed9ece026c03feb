"""Target assignment: which anchors should find which labelled box (DESIGN of PointPillars, section 4.1 of the paper).

NumPy, because it runs in the loader's processes beside pillarize and shares the geometry with it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.anchors import ANCHOR_YAWS_RAD, IGNORED, ClassSpec
from asca_pillars.geometry.boxes import encode_boxes
from asca_pillars.geometry.overlap import aligned_bev_iou


@dataclass(frozen=True)
class Targets:
    """What the head should say of one frame's anchors.

    Attributes:
        state: (H, W, A) int8: 1 positive, 0 negative, -1 takes no part in the loss.
        positives: (n,) flat indices into (H, W, A) of the positive anchors, ascending.
        anchors: (n, 7) float32 the positive anchors themselves, LiDAR frame.
        residuals: (n, 7) float32 box residuals of the positive anchors.
        directions: (n,) int64 direction bin of the positive anchors.
        matched: (n,) int64 the box, by its row, that each positive anchor is to find.
    """

    state: NDArray[np.int8]
    positives: NDArray[np.int64]
    anchors: NDArray[np.float32]
    residuals: NDArray[np.float32]
    directions: NDArray[np.int64]
    matched: NDArray[np.int64]


def assign_targets(
    anchors: NDArray[np.float32],
    classes: Sequence[ClassSpec],
    boxes: NDArray[np.float32],
    labels: NDArray[np.int64],
) -> Targets:
    """Match anchors with boxes by the overlap of their axis-aligned bird's-eye footprints.

    An anchor is positive when it overlaps a box of its own class by at least `positive_iou`, or when no anchor
    overlaps that box more, so that a small one is not missed (of two boxes with the same best anchor the later has
    it); negative below `negative_iou` with all of them; ignored in between, and wherever it overlaps an IGNORED box
    by `negative_iou` without being positive.

    Args:
        anchors: (H, W, A, 7), class-major along A, see `geometry.anchors.make_anchors`.
        classes: what anchor 2c and 2c + 1 look for.
        boxes: (N, 7) labelled boxes.
        labels: (N,) index into `classes`, or IGNORED.
    """
    rows, columns, per_cell = anchors.shape[:3]
    best_iou = np.zeros((rows, columns, per_cell))
    best_box = np.full((rows, columns, per_cell), -1)
    ignored = np.zeros((rows, columns, per_cell), dtype=bool)
    forced: list[tuple[NDArray[np.int64], int]] = []
    for box_index, (box, label) in enumerate(zip(boxes, labels, strict=True)):
        for class_index, spec in enumerate(classes):
            if label not in (class_index, IGNORED):
                continue
            window = _window(anchors, box, spec, class_index)
            near = anchors[window]
            iou = aligned_bev_iou(near.reshape(-1, 7), box[None])[:, 0].reshape(near.shape[:3])
            if label == IGNORED:
                ignored[window] |= iou >= spec.negative_iou
                continue
            closer = iou > best_iou[window]
            best_iou[window] = np.where(closer, iou, best_iou[window])
            best_box[window] = np.where(closer, box_index, best_box[window])
            if iou.size and iou.max() > 0:
                offset = [part.start for part in window]
                forced.append((np.argwhere(iou == iou.max()) + offset, box_index))
    positive_iou, negative_iou = (
        np.repeat([getattr(spec, name) for spec in classes], len(ANCHOR_YAWS_RAD))
        for name in ("positive_iou", "negative_iou")
    )
    state = -(best_iou >= negative_iou).astype(np.int8)
    state[best_iou >= positive_iou] = 1
    state[ignored & (state == 0)] = -1
    for places, box_index in forced:
        state[tuple(places.T)] = 1
        best_box[tuple(places.T)] = box_index
    positives = np.flatnonzero(state == 1)
    matched = best_box.reshape(-1)[positives]
    found = anchors.reshape(-1, 7)[positives]
    residuals, directions = encode_boxes(boxes[matched], found)
    return Targets(state, positives, found, residuals, directions, matched)


def _anchors_of(class_index: int) -> slice:
    yaws = len(ANCHOR_YAWS_RAD)
    return slice(class_index * yaws, (class_index + 1) * yaws)


def _window(
    anchors: NDArray[np.float32], box: NDArray[np.float32], spec: ClassSpec, class_index: int
) -> tuple[slice, slice, slice]:
    """The part of the anchor map that can overlap `box` at all; the rest would only cost time."""
    reach = (max(box[3], box[4]) + max(spec.length_m, spec.width_m)) / 2
    columns = np.searchsorted(anchors[0, :, 0, 0], (box[0] - reach, box[0] + reach))
    rows = np.searchsorted(anchors[:, 0, 0, 1], (box[1] - reach, box[1] + reach))
    return slice(*rows), slice(*columns), _anchors_of(class_index)
