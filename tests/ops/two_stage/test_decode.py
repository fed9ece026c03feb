"""From proposals, scores and residuals to detections.

Frames of boxes, residuals of a refinement, which proposals are sampled, and what should be said of them.
"""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.detection.anchors import IGNORED
from asca_pillars.detection.decode import PostProcess
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.boxes import corners, wrap_angle
from asca_pillars.ops.two_stage.decode import (
    FOREGROUND_IOU,
    HARD_IOU,
    Overlaps,
    boxes_from_frames,
    boxes_in_frames,
    decode_refinement,
    encode_refinement,
    from_box_frames,
    keypoint_states,
    match_proposals,
    refined_detections,
    refined_scores,
    reported_detections,
    roi_grid_points,
    roi_targets,
    sample_rois,
    to_box_frames,
)
from tests.ops.points.boxes_near import CHANGES, PROPOSALS, changed

NAMES = ("Car", "Cyclist")
POST = PostProcess(nms_iou=0.1, max_detections=3)


def at(*x_m: float) -> np.ndarray:
    return np.array([[x, 0, -1, 4, 2, 1.5, 0.1] for x in x_m], np.float32)


def refined(boxes: np.ndarray, to: np.ndarray, labels: list[int], scores: list[float]) -> Detections:
    proposals = Detections(boxes, np.full(len(boxes), 0.5, np.float32), np.array(labels, np.int64), NAMES)
    return refined_detections(proposals, np.array(scores, np.float32), encode_refinement(to, boxes), POST)


def test_boxes_move_and_what_comes_to_the_same_place_is_found_once() -> None:
    found = refined(at(10, 30, 50), at(11, 31, 51), [0, 0, 1], [0.2, 0.9, 0.6])
    np.testing.assert_allclose(found.boxes, at(31, 51, 11), atol=1e-5)
    np.testing.assert_allclose(found.scores, [0.9, 0.6, 0.2])
    assert found.names == ["Car", "Cyclist", "Car"]
    found = refined(at(10, 12, 10, 40, 60), at(11, 11, 11, 40, 60), [0, 0, 1, 0, 0], [0.3, 0.8, 0.7, 0.2, 0.1])
    np.testing.assert_allclose(found.boxes, at(11, 11, 40), atol=1e-5)
    assert found.labels.tolist() == [0, 1, 0], "three at most"
    scores, residuals = np.empty(0, np.float32), np.empty((0, 7), np.float32)
    assert len(refined_detections(Detections.empty(NAMES), scores, residuals, POST)) == 0


def test_what_is_not_finite_in_either_stage_is_counted() -> None:
    spec = PvRcnnModel().spec.with_score_threshold(0.1)
    boxes, labels = at(10, 30, 50), np.zeros(3, np.int64)
    proposals = Detections(boxes, np.full(3, 0.5, np.float32), labels, spec.class_names, non_finite=7)
    residuals = np.zeros((3, 7), np.float32)
    residuals[0, 0] = np.nan
    residuals[1, 0] = 3e38  # a place beyond float32
    found = reported_detections(proposals, np.full(3, 2.0, np.float32), residuals, spec, "second")
    np.testing.assert_allclose(found.boxes, at(50), atol=1e-5)
    assert found.non_finite == 7 + 2
    scores = np.array([2.0, np.nan, np.nan], np.float32)
    found = reported_detections(proposals, scores, np.zeros((3, 7), np.float32), spec, "second")
    np.testing.assert_allclose(found.boxes, at(10), atol=1e-5)
    assert found.non_finite == 7 + 2


def test_scores_of_both_stages_and_their_thresholds() -> None:
    proposals = Detections(at(10, 30), np.array([0.4, 0.9], np.float32), np.zeros(2, np.int64), NAMES)
    confidence = np.array([2.0, -1.0], np.float32)
    own = 1 / (1 + np.exp(-confidence))
    np.testing.assert_allclose(refined_scores(proposals, confidence, "second"), own, rtol=1e-6)
    np.testing.assert_allclose(refined_scores(proposals, confidence, "both"), np.sqrt(own * [0.4, 0.9]), rtol=1e-6)
    # The second stage would keep the first box alone, its proposals' scores the other one.
    spec = PvRcnnModel().spec.with_score_threshold(0.5)
    labels, places = np.zeros(2, np.int64), at(10, 30)
    proposals = Detections(places, np.array([0.2, 0.9], np.float32), labels, spec.class_names)
    confidence, residuals = np.array([1.0, -0.5], np.float32), np.zeros((2, 7), np.float32)
    second = reported_detections(proposals, confidence, residuals, spec, "second")
    both = reported_detections(proposals, confidence, residuals, spec, "both")
    np.testing.assert_allclose(second.boxes, places[:1], atol=1e-5)
    np.testing.assert_allclose(both.boxes, places[1:], atol=1e-5)
    np.testing.assert_allclose(both.scores, np.sqrt(0.9 / (1 + np.exp(0.5))), rtol=1e-6)


Change = tuple[np.ndarray, np.ndarray, float]
CAR = np.array([10, 0, -1, 4, 2, 1.5, 0], np.float32)


@given(PROPOSALS, st.integers(0, 2**32 - 1))
def test_frames_of_points_round_trip(box: np.ndarray, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-50, 50, (1, 20, 3))
    np.testing.assert_allclose(from_box_frames(to_box_frames(points, box[None]), box[None]), points, atol=1e-9)


@given(PROPOSALS, CHANGES)
def test_frames_of_boxes(frame: np.ndarray, change: Change) -> None:
    box = changed(frame, change)
    seen = boxes_in_frames(box[None], frame[None])
    # The corners of the box as seen are the corners, as seen.
    np.testing.assert_allclose(corners(seen)[0], to_box_frames(corners(box[None]), frame[None])[0], atol=1e-9)
    back = boxes_from_frames(seen, frame[None])[0]
    np.testing.assert_allclose(back[:6], box[:6], atol=1e-9)
    assert wrap_angle(back[6] - box[6]) == pytest.approx(0, abs=1e-9)


@given(PROPOSALS, CHANGES)
def test_a_refinement_is_decoded_and_half_a_turn_of_the_box_changes_nothing(
    proposal: np.ndarray, change: Change
) -> None:
    box = changed(proposal, change)
    turned = box + np.array([0, 0, 0, 0, 0, 0, math.pi])
    for own in (box, turned):
        residuals = encode_refinement(own[None], proposal[None])
        assert -math.pi / 2 <= residuals[0, 6] <= math.pi / 2
        (back,) = decode_refinement(residuals, proposal[None])
        np.testing.assert_allclose(back[:6], box[:6], rtol=1e-5, atol=2e-5)
        assert wrap_angle(float(back[6]) - box[6], math.pi) == pytest.approx(0, abs=1e-5)
        # Refinement does not turn the front to the back.
        assert abs(wrap_angle(float(back[6]) - proposal[6])) <= math.pi / 2 + 1e-5


def test_residuals_by_hand() -> None:
    # 3 by 4 m: the diagonal is 5. The heading is +y, so a box 1 m farther along y lies 1 m ahead.
    proposal = np.array([[10.0, 0, -1, 3, 4, 2, math.pi / 2]])
    box = np.array([[10.0, 1, -0.5, 6, 4, 1, math.pi / 2 + 0.1]])
    expected = [1 / 5, 0, 0.5 / 2, math.log(2), 0, -math.log(2), 0.1]
    assert encode_refinement(box, proposal)[0] == pytest.approx(expected, abs=1e-6)


def test_nothing_to_refine_or_to_find() -> None:
    none = np.empty((0, 7), np.float32)
    assert encode_refinement(none, none).shape == decode_refinement(none, none).shape == (0, 7)
    assert roi_grid_points(none, 6).shape == (0, 216, 3)
    assert math.prod(to_box_frames(np.empty((0, 4, 3)), none).shape) == 0
    found = match_proposals(proposals((0, 0), (1, 1)), np.empty((0, 7), np.float32), np.empty(0, np.int64))
    assert found.iou.tolist() == [0, 0]
    targets = roi_targets(proposals((0, 0), (1, 1)), np.empty((0, 7), np.float32), found, np.array([0, 1, 1]))
    assert targets.confidence.tolist() == [0, 0, 0]
    assert not targets.positive.any()


def proposals(*rows: tuple[float, int]) -> Detections:
    """Cars moved along x from CAR by so many metres, with these labels."""
    boxes = np.stack([CAR + np.array([dx, 0, 0, 0, 0, 0, 0], np.float32) for dx, _ in rows])
    labels = np.array([label for _, label in rows], np.int64)
    return Detections(boxes, np.full(len(rows), 0.5, np.float32), labels, ("Car", "Pedestrian"))


def overlaps(seed: int, count: int, kinds: int) -> Overlaps:
    rng = np.random.default_rng(seed)
    bands = [(0, 0.099), (0.1, 0.549), (0.56, 1)]
    chosen = [bands[k] for k in range(3) if kinds >> k & 1] or bands
    iou = np.array([rng.uniform(*chosen[rng.integers(len(chosen))]) for _ in range(count)])
    return Overlaps(iou, np.zeros(count, np.int64), rng.random(count) < 0.2)


def test_matching_is_by_class_and_minds_ignored_boxes() -> None:
    # Moved by d m, 4 m long boxes share (4 - d) / (4 + d).
    found = match_proposals(proposals((1, 0), (1, 1), (3, 0), (40, 0)), CAR[None], np.array([0]))
    assert found.iou == pytest.approx([3 / 5, 0, 1 / 7, 0])
    assert found.matched.tolist() == [0, -1, 0, -1]
    assert not found.ignored.any()
    boxes = np.stack([CAR, CAR + np.array([6, 0, 0, 0, 0, 0, 0], np.float32)])
    found = match_proposals(proposals((0, 0), (6, 0), (5, 1), (20, 0)), boxes, np.array([0, IGNORED]))
    assert found.ignored.tolist() == [False, True, True, False]


@given(st.integers(0, 2**32 - 1), st.integers(1, 200), st.integers(0, 7), st.integers(1, 128))
def test_quotas(seed: int, count: int, kinds: int, expected: int) -> None:
    found = overlaps(seed, count, kinds)
    rois = sample_rois(found, expected, np.random.default_rng(seed))
    again = sample_rois(found, expected, np.random.default_rng(seed))
    assert rois.tolist() == again.tolist()
    usable = found.iou[~found.ignored]
    assert len(rois) == (expected if len(usable) else 0)
    assert not found.ignored[rois].any()
    drawn = found.iou[rois]
    foreground = drawn[drawn >= FOREGROUND_IOU]
    background = drawn[drawn < FOREGROUND_IOU]
    there = (usable >= FOREGROUND_IOU).sum()
    if (usable < FOREGROUND_IOU).any() and len(rois):
        assert len(foreground) == min(there, round(expected / 2))
        assert len(np.unique(rois[drawn >= FOREGROUND_IOU])) == len(foreground)
        hard, easy = (usable < FOREGROUND_IOU) & (usable >= HARD_IOU), usable < HARD_IOU
        if hard.any() and easy.any():
            assert (background >= HARD_IOU).sum() == round(0.8 * len(background))


def test_targets() -> None:
    given = proposals((0, 0), (1, 0), (1.2, 0), (8 / 3, 0), (40, 0))
    found = match_proposals(given, CAR[None], np.array([0]))
    rois = np.array([0, 1, 2, 3, 4, 1])
    targets = roi_targets(given, CAR[None], found, rois)
    # Overlaps 1, 3/5, 2.8/5.2 = 0.538, 0.2 and 0.
    assert targets.confidence == pytest.approx([1, 0.7, 2 * (2.8 / 5.2 - 0.25), 0, 0, 0.7], abs=1e-5)
    assert targets.positive.tolist() == [True, True, False, False, False, True]
    back = decode_refinement(targets.residuals, given.boxes[rois])
    np.testing.assert_allclose(back[targets.positive], np.stack([CAR] * 3), atol=1e-5)
    np.testing.assert_allclose(targets.residuals[~targets.positive], 0, atol=1e-6)
    assert (targets.boxes[[0, 1, 5]] == CAR).all()


def test_keypoint_states() -> None:
    boxes = np.stack([CAR, CAR + np.array([10, 0, 0, 0, 0, 0, 0], np.float32)])
    x = np.array([10, 12.05, 12.2, 20, 22.05, 40], np.float32)
    keypoints = np.stack([x, 0 * x, 0 * x - 1], axis=1)
    assert keypoint_states(keypoints, boxes, np.array([0, IGNORED])).tolist() == [1, -1, 0, -1, -1, 0]
