"""Target assignment against a plain loop over all anchors, and by hand."""

import math

import numpy as np
from hypothesis import given, settings

from asca_pillars.detection.anchors import IGNORED, KITTI_CLASSES
from asca_pillars.detection.targets import Targets, assign_targets
from asca_pillars.geometry.boxes import decode_boxes, wrap_angle
from asca_pillars.geometry.overlap import aligned_bev_iou
from tests.detection.anchor_scenes import ANCHORS, COLUMNS, COUNT, PEDESTRIAN, ROWS, labelled_boxes, places


def assign(*labelled: tuple[int, list[float]]) -> Targets:
    boxes = np.array([box for _, box in labelled], np.float32).reshape(-1, 7)
    return assign_targets(ANCHORS, KITTI_CLASSES, boxes, np.array([label for label, _ in labelled], np.int64))


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


@settings(max_examples=100)
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


def test_no_boxes() -> None:
    targets = assign()
    assert targets.state.shape == (ROWS, COLUMNS, COUNT) and not targets.state.any()
    assert targets.positives.shape == targets.directions.shape == (0,)
    assert targets.residuals.shape == (0, 7)
    kinds = (targets.state, targets.positives, targets.residuals, targets.directions)
    assert [array.dtype for array in kinds] == [np.int8, np.int64, np.float32, np.int64]
