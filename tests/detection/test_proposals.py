"""Quotas of proposals, and proposals of a head whose every anchor has a score for every class."""

from dataclasses import replace

import numpy as np
import pytest

from asca_pillars.base.errors import ConfigError
from asca_pillars.detection.decode import HeadMaps, PostProcess, decode, sigmoid
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.proposals import (
    AnchorProposals,
    ProposalSettings,
    best_of_each_class,
    propose,
    propose_anchors,
)
from asca_pillars.geometry.boxes import encode_boxes
from asca_pillars.geometry.overlap import bev_iou
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec
from asca_pillars.ops.pv_rcnn.voxels import VoxelGrid
from tests.helpers.scenes import SPEC


def found(labels: list[int], scores: list[float]) -> Detections:
    boxes = np.arange(len(labels), dtype=np.float32)[:, None] * np.ones(7, np.float32)
    return Detections(boxes, np.array(scores, np.float32), np.array(labels, np.int64), ("Car", "Cyclist"))


def test_each_class_has_its_own_quota() -> None:
    kept = best_of_each_class(found([0, 0, 1, 0, 1, 1], [0.9, 0.8, 0.7, 0.6, 0.1, 0.2]), (2, 2))
    assert kept.boxes[:, 0].tolist() == [0, 1, 2, 5]
    assert len(best_of_each_class(Detections.empty(("Car", "Cyclist")), (5, 5))) == 0
    assert len(best_of_each_class(found([1], [0.1]), (5, 5))) == 1


def test_suppression_that_stops_at_the_quotas_proposes_the_same() -> None:
    height, width, count, _ = SPEC.anchors.shape
    rng = np.random.default_rng(0)
    maps = HeadMaps(*(rng.normal(0, 0.3, (n * count, height, width)).astype(np.float32) for n in (1, 7, 2)))
    settings = ProposalSettings(score_threshold=0.3, candidates=200, quotas=(7, 3, 5))
    classes = tuple(replace(item, score_threshold=0.3) for item in SPEC.classes)
    everything = decode(maps, SPEC.anchors, classes, PostProcess(settings.nms_iou, 200, 600))
    expected, found = best_of_each_class(everything, settings.quotas), propose(maps, SPEC, settings)
    assert len(everything) > 100 and np.bincount(found.labels).tolist() == [7, 3, 5]
    assert found.boxes.tobytes() == expected.boxes.tobytes() and found.scores.tobytes() == expected.scores.tobytes()


VOXELS = VoxelSpec(grid=VoxelGrid((0.0, 12.8), (-6.4, 6.4), size_m=(0.1, 0.1, 0.1)))
HEIGHT, WIDTH, ANCHORS, _ = VOXELS.anchors.shape


def anchor_maps(seed: int = 0) -> HeadMaps[np.ndarray]:
    rng = np.random.default_rng(seed)
    sizes = (3 * ANCHORS, 7 * ANCHORS, 2 * ANCHORS)
    return HeadMaps(*(rng.normal(0, 0.3, (size, HEIGHT, WIDTH)).astype(np.float32) for size in sizes))


def test_the_best_score_of_an_anchor_says_its_class() -> None:
    answer = anchor_maps()
    box = np.array([5.0, 1.0, -0.9, 4.2, 1.7, 1.5, 0.3], np.float32)
    residuals, direction = encode_boxes(box[None], VOXELS.anchors[7, 4, 0][None])
    answer.scores[:3, 7, 4] = (1.0, 9.0, 2.0)
    answer.boxes[:7, 7, 4] = residuals[0]
    answer.directions[:2, 7, 4] = (1.0, 2.0) if direction[0] else (2.0, 1.0)
    found = propose_anchors(answer, VOXELS, AnchorProposals(count=10))
    assert len(found) == 10 and found.names[0] == "Pedestrian"
    np.testing.assert_allclose(found.boxes[0], box, atol=1e-5)
    np.testing.assert_allclose(found.scores[0], sigmoid(np.array(9.0)), rtol=1e-6)
    assert (np.diff(found.scores) <= 0).all()


def test_suppression_is_blind_to_classes() -> None:
    found = propose_anchors(anchor_maps(), VOXELS, AnchorProposals(candidates=300, nms_iou=0.2, count=200))
    overlap = bev_iou(found.boxes, found.boxes)
    np.fill_diagonal(overlap, 0)
    assert overlap.max() <= 0.2 and len(set(found.labels)) == 3


def test_limits_and_numbers_that_are_not_finite() -> None:
    everything = AnchorProposals(candidates=10**6, nms_iou=1.0, count=10**6)
    whole = propose_anchors(anchor_maps(), VOXELS, everything)
    assert len(whole) == HEIGHT * WIDTH * ANCHORS
    few = propose_anchors(anchor_maps(), VOXELS, AnchorProposals(candidates=50, nms_iou=1.0, count=20))
    np.testing.assert_array_equal(few.boxes, whole.boxes[:20])
    broken = anchor_maps()
    broken.scores[:3, 0, 0] = np.nan
    broken.boxes[7, 0, 0] = np.inf
    assert propose_anchors(broken, VOXELS, everything).non_finite == 2
    broken.scores[:] = np.nan
    assert len(propose_anchors(broken, VOXELS, everything)) == 0


def test_what_cannot_be() -> None:
    with pytest.raises(ConfigError, match="nms_iou 2"):
        AnchorProposals(nms_iou=2.0)
    with pytest.raises(ConfigError, match="at least 1"):
        AnchorProposals(count=0)
