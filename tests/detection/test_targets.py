"""Both assignments of targets against plain loops over all anchors, and by hand."""

import dataclasses
import math
import statistics
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from asca_pillars.detection.anchors import IGNORED, KITTI_CLASSES, make_anchors
from asca_pillars.detection.targets import Assigner, Targets, assign_targets
from asca_pillars.geometry.boxes import decode_boxes, wrap_angle
from asca_pillars.geometry.overlap import aligned_bev_iou
from asca_pillars.ops.pillar.grid import PillarGrid

# Rectangular, asymmetric, both minima off zero. Head cells are 0.32 m along y and 0.64, 0.32, 0.16 m along x in
# the zones that begin at 2.00, 4.56 and 7.12 m: 16 rows, 4 + 8 + 16 columns.
GRID = PillarGrid(x_range_m=(2.0, 9.68), y_range_m=(-1.92, 3.2))
ANCHORS = make_anchors(*GRID.head_centers_m(), KITTI_CLASSES)
ROWS, COLUMNS, COUNT = 16, 28, 6
CAR, PEDESTRIAN, CYCLIST = range(3)
SIZES = {CAR: (3.9, 1.6, 1.56), PEDESTRIAN: (0.8, 0.6, 1.73), CYCLIST: (1.76, 0.6, 1.73)}
# Cells of 1 m with centers at 0, 1, ..., 8 m.
SQUARE = make_anchors(np.arange(9.0), np.arange(9.0), KITTI_CLASSES)
ROUNDING = 1e-6


@st.composite
def labelled_boxes(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """Up to six boxes in and around the grid, about as large as one of the classes."""
    labels = draw(st.lists(st.sampled_from([IGNORED, *SIZES]), max_size=6))
    boxes = []
    for label in labels:
        like = label if label != IGNORED else draw(st.sampled_from(list(SIZES)))
        stretch = [draw(st.floats(0.6, 1.8)) for _ in range(3)]
        center = draw(st.floats(-2.0, 14.0)), draw(st.floats(-5.0, 6.0)), draw(st.floats(-2.0, 0.5))
        boxes.append([*center, *np.multiply(SIZES[like], stretch), draw(st.floats(-math.pi, 3.14))])
    return np.array(boxes, np.float32).reshape(-1, 7), np.array(labels, np.int64)


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
        max((row[box] for row, own in zip(overlap, class_of, strict=True) if own == label), default=math.inf)
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


@settings(max_examples=50)
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


@pytest.mark.parametrize("assigner", ["overlap", "atss"])
def test_a_positive_anchor_is_not_ignored(assigner: Assigner) -> None:
    """A van, which is ignored, stands where a car does: the car is learnt all the same."""
    car = [4.0, 3.0, -1.0, 3.9, 1.6, 1.56, 0.0]
    alone, beside = (assign((CAR, car), *also, anchors=SQUARE, assigner=assigner) for also in ((), ((IGNORED, car),)))
    assert len(alone.positives) > 0 and beside.positives.tolist() == alone.positives.tolist()
    assert (beside.state.flat[beside.positives] == 1).all()


def test_fewer_cells_than_candidates() -> None:
    few = make_anchors(np.arange(2.0), np.arange(3.0), KITTI_CLASSES)
    targets = assign((CYCLIST, [1.0, 2.0, -0.6, 1.76, 0.6, 1.73, 0.0]), anchors=few, assigner="atss")
    assert targets.state[2, 1, 4] == 1


@pytest.mark.parametrize("assigner", ["overlap", "atss"])
def test_no_boxes(assigner: Assigner) -> None:
    targets = assign(assigner=assigner)
    assert targets.state.shape == (ROWS, COLUMNS, COUNT) and not targets.state.any()
    assert targets.state.dtype == np.int8
    shapes = [part.shape for part in (targets.positives, targets.anchors, targets.residuals, targets.matched)]
    assert shapes == [(0,), (0, 7), (0, 7), (0,)]
    kinds = (targets.positives, targets.anchors, targets.residuals, targets.directions, targets.matched)
    assert [part.dtype for part in kinds] == [np.int64, np.float32, np.float32, np.int64, np.int64]


def test_without_background_every_other_anchor_is_ignored() -> None:
    classes = [dataclasses.replace(KITTI_CLASSES[CAR], negative_iou=0.0), *KITTI_CLASSES[1:]]
    box = np.array([[4.0, 4.0, -1.0, 3.9, 1.6, 1.56, 0.0]], np.float32)
    for boxes, labels in ((box, np.array([CAR])), (box[:0], np.empty(0, np.int64))):
        state = assign_targets(SQUARE, classes, boxes, labels).state
        assert ((state[..., :2] == 1).any(), (state[..., :2] == 0).any()) == (len(boxes) > 0, False)
        assert (state[..., 2:] == 0).all(), "the other classes have background"
