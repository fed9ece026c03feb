"""Target assignment: matching of anchors with labelled boxes (PointPillars, arXiv 1812.05784, section 4.2).

NumPy, because it runs in the loader's processes beside pillarize and shares the geometry with it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.detection.anchors import ANCHOR_YAWS_RAD, IGNORED, ClassSpec
from asca_pillars.geometry.boxes import DIRECTION_OFFSET_RAD, encode_boxes, points_in_boxes
from asca_pillars.geometry.overlap import aligned_bev_iou

Assigner = Literal["overlap", "atss"]
"""Rule that makes an anchor positive, see `assign_targets`."""

_NEAREST = 9  # k of ATSS, which its authors found to matter little


@dataclass(frozen=True)
class Targets:
    """Training targets of one frame's anchors.

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
    assigner: Assigner = "overlap",
    direction_offset_rad: float = DIRECTION_OFFSET_RAD,
) -> Targets:
    """Match anchors with boxes by the overlap of their axis-aligned bird's-eye footprints.

    `overlap`: an anchor is positive when it overlaps a box of its own class by at least `positive_iou`, or when no
    anchor overlaps that box more, so that a small one is not missed (of two boxes with the same best anchor the later
    has it); negative below `negative_iou` with all of them; ignored in between.

    `atss` (arXiv 1912.02424, algorithm 1): of each yaw the 9 anchors of the box's class whose centers are nearest are
    its candidates. Those are positive whose center lies inside the box and whose overlap with it is at least mean plus
    standard deviation of all its candidates' overlaps. The best candidate is positive wherever its center lies: a
    pedestrian may stand between the centers. An anchor that two boxes claim goes to the one whose best it is, otherwise
    to the one that it overlaps more. All others are negative.

    Either way an anchor that overlaps an IGNORED box by `negative_iou` without being positive is ignored.

    Args:
        anchors: (H, W, A, 7), class-major along A, see `detection.anchors.make_anchors`.
        classes: class c is that of anchors 2c and 2c + 1.
        boxes: (N, 7) labelled boxes.
        labels: (N,) index into `classes`, or IGNORED.
        assigner: which of both.
        direction_offset_rad: where direction bin 0 begins, see `DetectorSpec`.
    """
    box_rows = np.flatnonzero(labels != IGNORED)
    if assigner == "overlap":
        state, positives, matched = _match_by_overlap(anchors, classes, boxes, labels, box_rows)
    else:
        state, positives, matched = _match_nearest(anchors, boxes, labels, box_rows)
    state[_ignored(anchors, classes, boxes[labels == IGNORED]) & (state == 0)] = -1
    positive_anchors = anchors.reshape(-1, 7)[positives]
    residuals, directions = encode_boxes(boxes[matched], positive_anchors, direction_offset_rad)
    return Targets(state, positives, positive_anchors, residuals, directions, matched)


class _Matches(NamedTuple):
    """`state`, `positives` and `matched` of `Targets`, without regard to IGNORED boxes."""

    state: NDArray[np.int8]
    positives: NDArray[np.int64]
    matched: NDArray[np.int64]


def _match_by_overlap(
    anchors: NDArray[np.float32],
    classes: Sequence[ClassSpec],
    boxes: NDArray[np.float32],
    labels: NDArray[np.int64],
    box_rows: NDArray[np.int64],
) -> _Matches:
    shape = anchors.shape[:3]
    # Touched in the windows around boxes alone: a map all around has a million anchors.
    best_iou, best_box = np.zeros(shape), np.empty(shape, np.int64)
    state = np.empty(shape, np.int8)
    state[:] = np.repeat([-(spec.negative_iou == 0) for spec in classes], len(ANCHOR_YAWS_RAD))
    windows: list[tuple[tuple[slice, slice, slice], ClassSpec]] = []
    forced: list[tuple[NDArray[np.int64], int]] = []
    for box_index in box_rows:
        label = labels[box_index]
        window, iou = _overlaps_nearby(anchors, boxes[box_index], classes[label], label)
        closer = iou > best_iou[window]
        best_iou[window] = np.where(closer, iou, best_iou[window])
        best_box[window] = np.where(closer, box_index, best_box[window])
        if iou.size and iou.max() > 0:
            offset = [part.start for part in window]
            forced.append((np.argwhere(iou == iou.max()) + offset, box_index))
        windows.append((window, classes[label]))
    for window, spec in windows:
        best = best_iou[window]
        state[window] = np.where(best >= spec.positive_iou, 1, -(best >= spec.negative_iou).astype(np.int8))
    for places, box_index in forced:
        state[tuple(places.T)] = 1
        best_box[tuple(places.T)] = box_index
    positives = np.flatnonzero(state == 1)
    return _Matches(state, positives, best_box.reshape(-1)[positives])


def _match_nearest(
    anchors: NDArray[np.float32], boxes: NDArray[np.float32], labels: NDArray[np.int64], box_rows: NDArray[np.int64]
) -> _Matches:
    matches = [_AtssMatches(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0))]
    matches += [_atss_matches(anchors, boxes[row], labels[row], row) for row in box_rows]
    places, matched_rows, weights = (np.concatenate(parts) for parts in zip(*matches, strict=True))
    order = np.lexsort((weights, places))
    places, matched_rows = places[order], matched_rows[order]
    strongest = np.diff(places, append=-1) != 0  # the last one at each place
    positives, matched = places[strongest], matched_rows[strongest]
    state = np.zeros(anchors.shape[:3], np.int8)
    state.reshape(-1)[positives] = 1
    return _Matches(state, positives, matched)


class _AtssMatches(NamedTuple):
    """Anchors matched with a box by ATSS."""

    places: NDArray[np.int64]
    """(n,) flat indices into (H, W, A)."""
    matched_rows: NDArray[np.int64]
    """(n,) row of the box."""
    weights: NDArray[np.float64]
    """(n,) weights; of several boxes that match an anchor, the one with the greatest weight has it."""


def _atss_matches(anchors: NDArray[np.float32], box: NDArray[np.float32], label: int, box_index: int) -> _AtssMatches:
    row, column = _nearest_cells(anchors, box)
    near = anchors[row, column, _anchors_of(label)]  # (9, 2, 7)
    iou = aligned_bev_iou(near.reshape(-1, 7), box[None]).reshape(near.shape[:2]).astype(np.float64)
    centers = np.column_stack([near[:, 0, :2], np.full(len(near), box[2])])
    inside = points_in_boxes(centers, box[None])
    best = iou == iou.max()
    cell, yaw = np.nonzero((iou > 0) & (best | (inside & (iou >= iou.mean() + iou.std()))))
    anchor = _anchors_of(label).start + yaw
    places = np.ravel_multi_index((row[cell], column[cell], anchor), anchors.shape[:3])
    return _AtssMatches(places, np.full(len(places), box_index), iou[cell, yaw] + best[cell, yaw])


def _nearest_cells(
    anchors: NDArray[np.float32], box: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return row and column of the cells nearest to the center of `box`, (9,) each; of equally near ones the first."""
    dx, dy = (
        np.abs(places.astype(np.float64) - center)
        for places, center in ((anchors[0, :, 0, 0], box[0]), (anchors[:, 0, 0, 1], box[1]))
    )
    # The nearest cells lie in the nearest columns and rows.
    columns, rows = (np.sort(np.argsort(apart, kind="stable")[:_NEAREST]) for apart in (dx, dy))
    squared = np.square(dx[columns])[None] + np.square(dy[rows])[:, None]
    nearest = np.argsort(squared, axis=None, kind="stable")[:_NEAREST]
    return rows[nearest // len(columns)], columns[nearest % len(columns)]


def _ignored(
    anchors: NDArray[np.float32], classes: Sequence[ClassSpec], boxes: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Return a mask of anchors (H, W, A) that overlap one of the IGNORED `boxes` by their class's `negative_iou`."""
    ignored = np.zeros(anchors.shape[:3], dtype=bool)
    for box in boxes:
        for class_index, spec in enumerate(classes):
            window, iou = _overlaps_nearby(anchors, box, spec, class_index)
            ignored[window] |= iou >= spec.negative_iou
    return ignored


def _overlaps_nearby(
    anchors: NDArray[np.float32], box: NDArray[np.float32], spec: ClassSpec, class_index: int
) -> tuple[tuple[slice, slice, slice], NDArray[np.float32]]:
    """Return the part of the anchor map that `_window` selects, and the overlaps of its anchors with `box`."""
    window = _window(anchors, box, spec, class_index)
    near = anchors[window]
    return window, aligned_bev_iou(near.reshape(-1, 7), box[None]).reshape(near.shape[:3])


def _anchors_of(class_index: int) -> slice:
    yaws = len(ANCHOR_YAWS_RAD)
    return slice(class_index * yaws, (class_index + 1) * yaws)


def _window(
    anchors: NDArray[np.float32], box: NDArray[np.float32], spec: ClassSpec, class_index: int
) -> tuple[slice, slice, slice]:
    """Return the part of the anchor map that can overlap `box`."""
    reach = (max(box[3], box[4]) + max(spec.length_m, spec.width_m)) / 2
    columns = np.searchsorted(anchors[0, :, 0, 0], (box[0] - reach, box[0] + reach))
    rows = np.searchsorted(anchors[:, 0, 0, 1], (box[1] - reach, box[1] + reach))
    return slice(*rows), slice(*columns), _anchors_of(class_index)


_Doubles = NDArray[np.float64]
_Indices = NDArray[np.int64]

UNMATCHED = -1
_ROUNDING = 1e-12  # sums of overlaps that differ by less are equal


def greedy_matches(detections: _Indices, objects: _Indices) -> NDArray[np.bool_]:
    """Walk through candidate pairs and match each whose detection and object are both still free.

    Args:
        detections, objects: (P,) the pairs, in order of preference: by descending score of the detection, and for each
            detection by descending overlap.

    Returns:
        (P,) which pairs are matched.
    """
    matched = np.zeros(len(detections), dtype=bool)
    matched_detections: set[int] = set()
    matched_objects: set[int] = set()
    for row, (detection, item) in enumerate(zip(detections.tolist(), objects.tolist(), strict=True)):
        if detection not in matched_detections and item not in matched_objects:
            matched_detections.add(detection)
            matched_objects.add(item)
            matched[row] = True
    return matched


def match_by_overlap(overlap: _Doubles, least: float) -> tuple[_Indices, _Indices]:
    """Match each detection with the free object that it overlaps most: (D, O) -> (M,) detections, (M,) objects.

    Args:
        overlap: intersection over union; detections stand by descending score.
        least: smallest overlap of a match.
    """
    detections, objects = np.nonzero(overlap >= least)
    order = np.lexsort((-overlap[detections, objects], detections))
    pairs = order[greedy_matches(detections[order], objects[order])]
    return detections[pairs], objects[pairs]


def best_assignments(overlap: _Doubles) -> _Indices:
    """Return the one-to-one matching of greatest total overlap of the first k detections, for every k.

    Exact. Detections come one after the other; a new one changes the best matching along a single chain of detections
    that hand their objects on (Hungarian method), and few detections touch more than one object.

    Args:
        overlap: (N, M) of N detections with M objects; 0 where the two must not match.

    Returns:
        (N + 1, M): in row k which of the first k detections holds each object, or UNMATCHED.
    """
    holders = np.full((len(overlap) + 1, overlap.shape[1]), UNMATCHED)
    touching = np.any(overlap > 0, axis=1).tolist()
    for row in range(len(overlap)):
        holders[row + 1] = holders[row]
        if touching[row]:
            _admit(row, overlap, holders[row + 1])
    return holders


def _admit(row: int, overlap: _Doubles, holders: _Indices) -> None:
    """Bring `holders` (M,), the best matching of the detections before `row`, up to date with `row`.

    `gain[j]` is the most that the matching gains by a chain at whose end object j changes hands, not counting what its
    old holder loses; `source[j]` is the object that its new holder leaves, or UNMATCHED for `row` itself.
    """
    gain = _weights(overlap[row])
    source = np.full(len(holders), UNMATCHED)
    waiting = np.flatnonzero(gain > 0).tolist()
    for column in waiting:  # grows on the way
        if holders[column] == UNMATCHED:
            continue
        held = overlap[holders[column]]
        moved = gain[column] - held[column] + _weights(held)
        better = np.flatnonzero(moved > gain + _ROUNDING)
        gain[better], source[better] = moved[better], column
        waiting += better.tolist()

    lost = np.where(holders == UNMATCHED, 0.0, overlap[holders, np.arange(len(holders))])
    column = int((gain - lost).argmax())
    if gain[column] - lost[column] <= _ROUNDING:
        return
    while source[column] != UNMATCHED:
        holders[column] = holders[source[column]]
        column = int(source[column])
    holders[column] = row


def _weights(overlap: _Doubles) -> _Doubles:
    return np.where(overlap > 0, overlap, -np.inf)
