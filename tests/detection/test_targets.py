"""Target assignment against a plain loop over all anchors, and by hand on a grid of three zones."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings

from asca_pillars.detection.anchors import IGNORED, KITTI_CLASSES
from asca_pillars.detection.targets import Targets, assign_targets
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
    SIZES,
    labelled_boxes,
    places,
)


def assign(*labelled: tuple[int, list[float]]) -> Targets:
    boxes = np.array([box for _, box in labelled], np.float32).reshape(-1, 7)
    return assign_targets(ANCHORS, KITTI_CLASSES, boxes, np.array([label for label, _ in labelled], np.int64))


def box_at(row: int, column: int, label: int = PEDESTRIAN, dx: float = 0.0, yaw: float = 0.0) -> list[float]:
    """A box of its class's anchor size, `dx` beside the center of a head cell."""
    x, y = ANCHORS[row, column, 0, :2]
    return [x + dx, y, -0.9, *SIZES[label], yaw]


def assign_twin(boxes: np.ndarray, labels: np.ndarray) -> tuple[list[int], dict[int, int]]:
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


@settings(max_examples=40)
@given(labelled_boxes())
def test_equals_a_plain_loop_over_all_anchors(labelled: tuple[np.ndarray, np.ndarray]) -> None:
    boxes, labels = labelled
    targets = assign_targets(ANCHORS, KITTI_CLASSES, boxes, labels)
    states, matches = assign_twin(boxes, labels)
    assert targets.state.reshape(-1).tolist() == states
    assert targets.positives.tolist() == sorted(matches)
    assert targets.matched.tolist() == [matches[index] for index in sorted(matches)]
    decoded = decode_boxes(targets.residuals, targets.directions, ANCHORS.reshape(-1, 7)[targets.positives])
    expected = boxes[[matches[index] for index in sorted(matches)]].reshape(-1, 7)
    np.testing.assert_allclose(decoded[:, :6], expected[:, :6], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(wrap_angle(decoded[:, 6] - expected[:, 6]), 0, atol=2e-6)


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


def test_positives_by_hand_where_cells_are_coarse() -> None:
    """As above in the first zone, whose cells are 0.64 m apart along x: (0.8 - 0.64) / 1.44 = 0.11."""
    targets = assign((PEDESTRIAN, [2.0 + 2.5 * 0.64, 1.12, -0.9, 0.8, 0.6, 1.73, math.pi / 2]))
    assert places(targets, 1) == {(9, 2, 2), (9, 2, 3)}
    # Turned by 90 degrees it is 0.8 m along y: 0.48 / 1.12 = 0.43 one row further.
    assert places(targets, -1) == {(8, 2, 3), (10, 2, 3)}
    assert targets.directions.tolist() == [0, 0]


def test_a_box_that_fits_no_anchor_well_gets_its_best_one() -> None:
    """0.30 m beside an anchor: 0.5 / 1.1 = 0.455 < positive_iou; 0.34 m from the next one: 0.46 / 1.14 = 0.404."""
    targets = assign((PEDESTRIAN, box_at(9, 2, dx=0.30)))
    assert places(targets, 1) == {(9, 2, 2)}
    assert places(targets, -1) == {(9, 3, 2)}
    np.testing.assert_allclose(targets.residuals[0, 0], 0.30 / math.hypot(0.8, 0.6), rtol=1e-5)


def test_every_box_is_to_be_found() -> None:
    """A box far too long for any anchor, and a perfect one."""
    long_box = box_at(4, 8, CYCLIST)
    long_box[3] = 5.6  # 1.76 / 5.6 = 0.31: below negative_iou everywhere
    targets = assign((CYCLIST, long_box), (CYCLIST, box_at(12, 8, CYCLIST)))
    found = decode_boxes(targets.residuals, targets.directions, ANCHORS.reshape(-1, 7)[targets.positives])
    assert {round(float(y), 2) for y in found[:, 1]} == {round(float(ANCHORS[row, 0, 0, 1]), 2) for row in (4, 12)}


def test_ignored_boxes_excuse_what_they_cover_for_every_class() -> None:
    targets = assign((IGNORED, box_at(9, 8)))
    assert not len(targets.positives) and not places(targets, 1)
    # Cells are 0.32 m apart. A cyclist's anchor that covers the box: 0.48 / 1.056 = 0.4545 >= 0.35, up to
    # (1.76 - 0.8) / 2 = 0.48 m beside it; at 0.64 m 0.64 * 0.6 = 0.384 of 1.152 is 0.33. Turned by 90 degrees it
    # shares 0.6 * 0.6 / 1.176 = 0.31. A car's: 0.48 / 6.24.
    pedestrian = {(9, 8, 2), (9, 8, 3), (9, 7, 2), (9, 9, 2)}
    assert places(targets, -1) == pedestrian | {(9, 7, 4), (9, 8, 4), (9, 9, 4)}


def test_ignored_boxes_leave_positives_alone() -> None:
    box = box_at(9, 8)
    alone, both = assign((PEDESTRIAN, box)), assign((PEDESTRIAN, box), (IGNORED, box))
    assert places(alone, 1) == places(both, 1) == {(9, 8, 2), (9, 8, 3)}
    assert np.array_equal(alone.residuals, both.residuals)
    forced = box_at(9, 2, dx=0.30)  # by force alone, as above
    assert places(assign((PEDESTRIAN, forced), (IGNORED, forced)), 1) == {(9, 2, 2)}


@pytest.mark.parametrize("label", [CAR, PEDESTRIAN, CYCLIST])
def test_classes_do_not_meet(label: int) -> None:
    """Even a box that fits the anchors of another class leaves them background."""
    for size_of in SIZES:
        targets = assign((label, [*box_at(8, 14)[:3], *SIZES[size_of], 0.0]))
        touched = {anchor // 2 for _, _, anchor in places(targets, 1) | places(targets, -1)}
        assert touched == {label}


def test_the_better_box_gets_the_anchor() -> None:
    """Two people 0.32 m apart, each on an anchor of its own: neither takes the other's, whatever the order."""
    boxes = [(PEDESTRIAN, box_at(9, 8)), (PEDESTRIAN, box_at(9, 9))]
    for order in (boxes, boxes[::-1]):
        targets = assign(*order)
        assert places(targets, 1) == {(9, column, anchor) for column in (8, 9) for anchor in (2, 3)}
        np.testing.assert_allclose(targets.residuals[:, 0], 0, atol=1e-6)


@pytest.mark.parametrize(("x", "y"), [(-0.6, 1.0), (12.5, 1.0), (6.0, -4.5), (6.0, 5.8), (500.0, 0.0)])
@pytest.mark.parametrize("label", [CAR, IGNORED])
def test_boxes_outside_the_grid_change_nothing(x: float, y: float, label: int) -> None:
    """1.8 x 1.4 m: a car's anchor, 3.9 m long one way or the other, meets it within 2.85 m along x, 2.65 m along y.

    The outermost centers are x = 2.32 and 9.60 m, y = -1.76 and 3.04 m.
    """
    assert not assign((label, [x, y, -1.0, 1.8, 1.4, 1.5, 0.0])).state.any()


def test_a_box_across_the_border_is_found_from_inside() -> None:
    """Its center is 0.5 m before the grid; the nearest anchors, at 2.32 m, are those that overlap it most."""
    targets = assign((CAR, [1.5, ANCHORS[6, 0, 0, 1], -1.0, 3.9, 1.6, 1.56, 0.0]))
    # (3.9 - 0.82) / (3.9 + 0.82) = 0.65, and 0.45 one cell further: (3.9 - 1.46) / 5.36 = 0.455. One row beside
    # it: 3.08 * 1.28 = 3.94 of 8.54 is 0.46.
    assert places(targets, 1) == {(6, 0, 0)}
    assert places(targets, -1) == {(6, 1, 0), (5, 0, 0), (7, 0, 0)}


def test_no_boxes() -> None:
    targets = assign()
    assert targets.state.shape == (ROWS, COLUMNS, COUNT) and not targets.state.any()
    assert targets.positives.shape == targets.directions.shape == (0,)
    assert targets.residuals.shape == (0, 7)
    kinds = (targets.state, targets.positives, targets.residuals, targets.directions)
    assert [array.dtype for array in kinds] == [np.int8, np.int64, np.float32, np.int64]


def test_thresholds_come_from_the_class() -> None:
    """The neighbors of the hand-made case, at IoU 0.667 and 0.429, under other thresholds."""
    strict = dataclasses.replace(KITTI_CLASSES[PEDESTRIAN], positive_iou=0.7, negative_iou=0.5)
    classes = (KITTI_CLASSES[0], strict, KITTI_CLASSES[2])
    boxes = np.array([[8.48, 1.12, -0.9, 0.8, 0.6, 1.73, 0.0]], np.float32)
    targets = assign_targets(ANCHORS, classes, boxes, np.array([PEDESTRIAN]))
    assert places(targets, 1) == {(9, 20, 2)}
    assert places(targets, -1) == {(9, 19, 2), (9, 21, 2), (9, 19, 3), (9, 20, 3), (9, 21, 3)}
