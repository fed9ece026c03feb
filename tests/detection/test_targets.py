"""Both assignments of targets against plain loops over all anchors, and by hand."""

import math
import statistics
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings

from asca_pillars.detection.anchors import IGNORED, KITTI_CLASSES, make_anchors
from asca_pillars.detection.targets import Assigner, Targets, assign_targets
from asca_pillars.geometry.boxes import decode_boxes, wrap_angle
from asca_pillars.geometry.overlap import aligned_bev_iou
from tests.detection.anchor_scenes import (
    ANCHORS,
    CAR,
    COLUMNS,
    COUNT,
    CYCLIST,
    PEDESTRIAN,
    ROWS,
    labelled_boxes,
    places,
)

# Cells of 1 m with centers at 0, 1, ..., 8 m.
SQUARE = make_anchors(np.arange(9.0), np.arange(9.0), KITTI_CLASSES)
ROUNDING = 1e-6


def assign(
    *labelled: tuple[int, list[float]], anchors: np.ndarray = ANCHORS, assigner: Assigner = "overlap"
) -> Targets:
    boxes = np.array([box for _, box in labelled], np.float32).reshape(-1, 7)
    labels = np.array([label for label, _ in labelled], np.int64)
    return assign_targets(anchors, KITTI_CLASSES, boxes, labels, assigner)


def overlap_twin(boxes: np.ndarray, labels: np.ndarray) -> tuple[list[int], dict[int, int]]:
    """State of every anchor, and the box of each positive one: no windows, one anchor at a time."""
    overlap = aligned_bev_iou(ANCHORS.reshape(-1, 7), boxes).tolist()
    class_of = [index % COUNT // 2 for index in range(len(overlap))]
    best_of_box = [
        max(row[box] for row, own in zip(overlap, class_of, strict=True) if own == label)
        if label != IGNORED
        else math.inf
        for box, label in enumerate(labels)
    ]
    states, matches = [], {}
    for index, row in enumerate(overlap):
        label, spec = class_of[index], KITTI_CLASSES[class_of[index]]
        own = [box for box in range(len(boxes)) if labels[box] == label]
        best = max(own, key=lambda box: row[box], default=-1)
        forced = [box for box in own if 0 < row[box] == best_of_box[box]]
        if forced or (best >= 0 and row[best] >= spec.positive_iou):
            states.append(1)
            matches[index] = forced[-1] if forced else best
        elif best >= 0 and row[best] >= spec.negative_iou:
            states.append(-1)
        else:
            excused = any(labels[box] == IGNORED and row[box] >= spec.negative_iou for box in range(len(boxes)))
            states.append(-1 if excused else 0)
    return states, matches


def candidates_twin(anchors: list[list[float]], box: list[float], label: int, count: int) -> list[int]:
    """Return the nine nearest anchors of the class for each yaw."""
    chosen = []
    for kind in (2 * label, 2 * label + 1):
        own = range(kind, len(anchors), count)
        chosen += sorted(own, key=lambda i: ((anchors[i][0] - box[0]) ** 2 + (anchors[i][1] - box[1]) ** 2, i))[:9]
    return chosen


def depth_inside(center: list[float], box: list[float]) -> float:
    """How far a place lies inside a box seen from above, negative outside, metres."""
    dx, dy = center[0] - box[0], center[1] - box[1]
    along = dx * math.cos(box[6]) + dy * math.sin(box[6])
    across = dy * math.cos(box[6]) - dx * math.sin(box[6])
    return min(box[3] / 2 - abs(along), box[4] / 2 - abs(across))


def atss_twin(boxes: np.ndarray, labels: np.ndarray) -> tuple[list[int], dict[int, int]]:
    """State of every anchor of ANCHORS, and the box of each positive one."""
    anchors = ANCHORS.reshape(-1, 7).astype(np.float64).tolist()
    overlap = aligned_bev_iou(ANCHORS.reshape(-1, 7), boxes).tolist()
    claims: dict[int, list[tuple[bool, float, int]]] = {}
    for row, (box, label) in enumerate(zip(boxes.astype(np.float64).tolist(), labels.tolist(), strict=True)):
        if label == IGNORED:
            continue
        candidates = candidates_twin(anchors, box, label, COUNT)
        values = [overlap[index][row] for index in candidates]
        floor = statistics.fmean(values) + statistics.pstdev(values)
        for index, value in zip(candidates, values, strict=True):
            if value == 0:
                continue
            if value == max(values):
                claims.setdefault(index, []).append((True, value, row))
                continue
            depth = depth_inside(anchors[index], box)
            assume(abs(value - floor) > ROUNDING and abs(depth) > ROUNDING)
            if value > floor and depth > 0:
                claims.setdefault(index, []).append((False, value, row))
    matches = {index: max(rivals)[2] for index, rivals in claims.items()}
    states = []
    for index, row in enumerate(overlap):
        negative_iou = KITTI_CLASSES[index % COUNT // 2].negative_iou
        excused = any(label == IGNORED and iou >= negative_iou for label, iou in zip(labels, row, strict=True))
        states.append(1 if index in matches else -1 if excused else 0)
    return states, matches


@settings(max_examples=100)
@given(labelled_boxes())
@pytest.mark.parametrize(("assigner", "twin"), [("overlap", overlap_twin), ("atss", atss_twin)])
def test_equals_a_plain_loop_over_all_anchors(
    assigner: Assigner, twin: Callable[..., Any], labelled: tuple[np.ndarray, np.ndarray]
) -> None:
    boxes, labels = labelled
    targets = assign_targets(ANCHORS, KITTI_CLASSES, boxes, labels, assigner)
    states, matches = twin(boxes, labels)
    assert targets.state.reshape(-1).tolist() == states
    assert targets.positives.tolist() == sorted(matches)
    assert targets.matched.tolist() == [matches[index] for index in sorted(matches)]
    np.testing.assert_array_equal(targets.anchors, ANCHORS.reshape(-1, 7)[targets.positives])
    decoded = decode_boxes(targets.residuals, targets.directions, targets.anchors)
    np.testing.assert_allclose(decoded[:, :6], boxes[targets.matched, :6], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(wrap_angle(decoded[:, 6] - boxes[targets.matched, 6]), 0, atol=2e-6)


def test_positives_by_hand_in_the_third_zone() -> None:
    """A pedestrian on the center of row 9, column 20: x = 7.12 + 8.5 * 0.16, y = -1.92 + 9.5 * 0.32.

    It has the anchor's size. The IoU of 0.8 x 0.6 with itself d further along x is (0.8 - d) / (0.8 + d): 0.667,
    0.429, 0.25 for d = 0.16, 0.32, 0.48. With the anchor turned by 90 degrees it shares s = min(0.6, 0.7 - d) * 0.6,
    s / (0.96 - s): 0.6, 0.509, 0.311 for d = 0, 0.16, 0.32. One row further, 0.32 along y, 0.304 and 0.311.
    Positive from 0.5, negative below 0.35.
    """
    targets = assign((PEDESTRIAN, [8.48, 1.12, -0.9, 0.8, 0.6, 1.73, 0.0]))
    assert places(targets, 1) == {(9, column, anchor) for column in (19, 20, 21) for anchor in (2, 3)}
    assert places(targets, -1) == {(9, 18, 2), (9, 22, 2)}
    flat = (9 * 28 + 20) * 6 + 2
    assert flat in targets.positives.tolist()
    # dz over the anchor's height: (-0.9 + 0.6) / 1.73. The yaw 0 is in bin 1, see `detection.anchors`.
    np.testing.assert_allclose(
        targets.residuals[targets.positives.tolist().index(flat)], [0, 0, -0.3 / 1.73, 0, 0, 0, 0], atol=1e-6
    )
    assert targets.directions.tolist() == [1] * 6


@pytest.mark.parametrize(("length_m", "columns"), [(1.95, {4}), (2.05, {3, 4, 5})])
def test_adaptive_positives_by_hand(length_m: float, columns: set[int]) -> None:
    """A short car on the center of a cell, whose neighbors overlap it enough, but stand 1 m away.

    1.95 x 1.6 m within an anchor of 3.9 x 1.6: 0.5; 1 m along x it shares 1.925 x 1.6, 0.4904; 1 m along y 1.95 x 0.6,
    0.1429; both, 0.1408. The turned anchor, 1.6 x 3.9: 0.3765, the same along y, and 0.1527 wherever x differs.
    Mean of 0.5, 2 x 0.4904, 2 x 0.1429, 4 x 0.1408, 3 x 0.3765 and 6 x 0.1527: 0.2431, standard deviation 0.1399:
    positive from 0.3830 within 0.975 m. With 2.05 m the neighbors' centers lie inside.
    """
    targets = assign((CAR, [4.0, 3.0, -1.0, length_m, 1.6, 1.56, 0.0]), anchors=SQUARE, assigner="atss")
    assert places(targets, 1) == {(3, column, 0) for column in columns}
    assert not (targets.state == -1).any()


def test_an_anchor_of_two_boxes_goes_to_the_one_whose_best_it_is() -> None:
    """A car of the anchor's size would also have the next column, which it overlaps by 2.9 / 4.9 = 0.59.

    A narrow one, 3.0 x 1.0 m, lies within that anchor, 3 / 6.24 = 0.48, and within no other: it is its own. A short one
    on the car's own center has nothing better either, but overlaps it less.
    """
    fitting = [4.0, 3.0, -1.0, 3.9, 1.6, 1.56, 0.0]
    narrow, short = [5.4, 3.0, -1.0, 3.0, 1.0, 1.56, 0.0], [4.0, 3.1, -1.0, 2.0, 1.6, 1.56, 0.0]
    for other, column, winner in ((narrow, 5, narrow), (short, 4, fitting)):
        for order in ([fitting, other], [other, fitting]):
            targets = assign(*((CAR, box) for box in order), anchors=SQUARE, assigner="atss")
            taken = dict(zip(targets.positives.tolist(), targets.matched.tolist(), strict=True))
            assert taken[(3 * 9 + column) * COUNT] == order.index(winner)
            assert taken[(3 * 9 + 3) * COUNT] == order.index(fitting)


def test_fewer_cells_than_candidates() -> None:
    few = make_anchors(np.arange(2.0), np.arange(3.0), KITTI_CLASSES)
    targets = assign((CYCLIST, [1.0, 2.0, -0.6, 1.76, 0.6, 1.73, 0.0]), anchors=few, assigner="atss")
    assert (2, 1, 4) in places(targets, 1)


@pytest.mark.parametrize("assigner", ["overlap", "atss"])
def test_no_boxes(assigner: Assigner) -> None:
    targets = assign(assigner=assigner)
    assert targets.state.shape == (ROWS, COLUMNS, COUNT) and not targets.state.any()
    assert targets.state.dtype == np.int8
    shapes = [part.shape for part in (targets.positives, targets.anchors, targets.residuals, targets.matched)]
    assert shapes == [(0,), (0, 7), (0, 7), (0,)]
    kinds = (targets.positives, targets.anchors, targets.residuals, targets.directions, targets.matched)
    assert [part.dtype for part in kinds] == [np.int64, np.float32, np.float32, np.int64, np.int64]
