"""From proposals, scores and residuals to detections."""

import numpy as np

from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.detection.decode import PostProcess
from asca_pillars.detection.detections import Detections
from asca_pillars.ops.two_stage.decode import refined_detections, refined_scores, reported_detections
from asca_pillars.ops.two_stage.rois import encode_refinement

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
