"""Proposals of a head whose every anchor has a score for every class."""

import numpy as np
import pytest

from asca_pillars.base.errors import ConfigError
from asca_pillars.detection.decode import HeadMaps, sigmoid
from asca_pillars.detection.proposals import AnchorProposals, propose_anchors
from asca_pillars.geometry.boxes import encode_boxes
from asca_pillars.geometry.overlap import bev_iou
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec
from asca_pillars.ops.pv_rcnn.voxels import VoxelGrid

SPEC = VoxelSpec(grid=VoxelGrid((0.0, 12.8), (-6.4, 6.4), size_m=(0.1, 0.1, 0.1)))
HEIGHT, WIDTH, ANCHORS, _ = SPEC.anchors.shape


def maps(seed: int = 0) -> HeadMaps[np.ndarray]:
    rng = np.random.default_rng(seed)
    sizes = (3 * ANCHORS, 7 * ANCHORS, 2 * ANCHORS)
    return HeadMaps(*(rng.normal(0, 0.3, (size, HEIGHT, WIDTH)).astype(np.float32) for size in sizes))


def test_the_best_score_of_an_anchor_says_its_class() -> None:
    answer = maps()
    box = np.array([5.0, 1.0, -0.9, 4.2, 1.7, 1.5, 0.3], np.float32)
    residuals, direction = encode_boxes(box[None], SPEC.anchors[7, 4, 0][None])
    answer.scores[:3, 7, 4] = (1.0, 9.0, 2.0)
    answer.boxes[:7, 7, 4] = residuals[0]
    answer.directions[:2, 7, 4] = (1.0, 2.0) if direction[0] else (2.0, 1.0)
    found = propose_anchors(answer, SPEC, AnchorProposals(count=10))
    assert len(found) == 10 and found.names[0] == "Pedestrian"
    np.testing.assert_allclose(found.boxes[0], box, atol=1e-5)
    np.testing.assert_allclose(found.scores[0], sigmoid(np.array(9.0)), rtol=1e-6)
    assert (np.diff(found.scores) <= 0).all()


def test_suppression_is_blind_to_classes() -> None:
    found = propose_anchors(maps(), SPEC, AnchorProposals(candidates=300, nms_iou=0.2, count=200))
    overlap = bev_iou(found.boxes, found.boxes)
    np.fill_diagonal(overlap, 0)
    assert overlap.max() <= 0.2 and len(set(found.labels)) == 3


def test_limits_and_numbers_that_are_not_finite() -> None:
    everything = AnchorProposals(candidates=10**6, nms_iou=1.0, count=10**6)
    whole = propose_anchors(maps(), SPEC, everything)
    assert len(whole) == HEIGHT * WIDTH * ANCHORS
    few = propose_anchors(maps(), SPEC, AnchorProposals(candidates=50, nms_iou=1.0, count=20))
    np.testing.assert_array_equal(few.boxes, whole.boxes[:20])
    broken = maps()
    broken.scores[:3, 0, 0] = np.nan
    broken.boxes[7, 0, 0] = np.inf
    assert propose_anchors(broken, SPEC, everything).non_finite == 2
    broken.scores[:] = np.nan
    assert len(propose_anchors(broken, SPEC, everything)) == 0


def test_what_cannot_be() -> None:
    with pytest.raises(ValueError, match="must have shapes"):
        propose_anchors(maps()._replace(scores=maps().scores[:6]), SPEC, AnchorProposals())
    with pytest.raises(ConfigError, match="nms_iou 2"):
        AnchorProposals(nms_iou=2.0)
    with pytest.raises(ConfigError, match="at least 1"):
        AnchorProposals(count=0)
