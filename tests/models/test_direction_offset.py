"""What training teaches of directions is what every decoder reads, wherever the bins begin."""

import dataclasses
import math

import numpy as np
import pytest

from asca_pillars.config.pillar import PillarModel
from asca_pillars.detection.decode import HeadMaps, PostProcess
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.proposals import AnchorProposals, ProposalSettings, propose, propose_anchors
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.detection.targets import Targets
from asca_pillars.models.pillar.network import build_pillar_detector
from asca_pillars.models.pv_rcnn.network import build_pv_rcnn_detector
from tests.helpers.scenes import SPEC
from tests.models.pv_rcnn import tiny_pv_rcnn
from tests.models.pv_rcnn.tiny_pv_rcnn import frame

POST = PostProcess(nms_iou=0.1)


def taught(targets: Targets, spec: DetectorSpec, scores_per_anchor: int) -> HeadMaps[np.ndarray]:
    """Head maps of a network that says what its targets ask for."""
    height, width, anchors, _ = spec.anchors.shape
    scores = np.full((height * width * anchors, scores_per_anchor), -20, np.float32)
    residuals = np.zeros((len(scores), 7), np.float32)
    directions = np.zeros((len(scores), 2), np.float32)
    own = targets.positives % anchors // 2 if scores_per_anchor > 1 else 0
    scores[targets.positives, own] = 10
    residuals[targets.positives] = targets.residuals
    directions[targets.positives, targets.directions] = 1
    return HeadMaps(
        *(part.reshape(height, width, -1).transpose(2, 0, 1).copy() for part in (scores, residuals, directions))
    )


def assert_headings(detections: Detections, boxes: np.ndarray) -> None:
    """Each box is found, and none of what is found is turned round."""
    found = detections[detections.scores > 0.5].boxes
    apart = np.abs(found[:, None, :3] - boxes[None, :, :3]).max(axis=2)
    assert (apart.min(axis=0) < 1e-3).all()
    turned = found[:, 6] - boxes[apart.argmin(axis=1), 6]
    np.testing.assert_allclose(np.cos(turned), 1, atol=1e-4)


@pytest.mark.parametrize("offset", [math.pi / 4, -math.pi / 2, 2.0])
def test_headings_survive_training_and_decoding(offset: float) -> None:
    labelled = frame(0)
    turns = np.radians([100.0, -80.0, 30.0, 170.0])
    labelled.boxes[:, 6] = turns[: len(labelled.boxes)]

    spec = dataclasses.replace(SPEC, direction_offset_rad=offset, post=POST)
    preparation = build_pillar_detector(PillarModel(spec=spec)).preparation
    sample = preparation.prepare(labelled, None)
    assert len(set(sample.targets.directions)) == 2
    boxes = labelled.boxes[np.unique(sample.targets.matched)]
    maps = taught(sample.targets, spec, 1)
    assert_headings(spec.decode(maps), boxes)
    assert_headings(propose(maps, spec, ProposalSettings(nms_iou=0.1)), boxes)

    voxels = dataclasses.replace(tiny_pv_rcnn.SPEC, direction_offset_rad=offset, post=POST)
    detector = build_pv_rcnn_detector(dataclasses.replace(tiny_pv_rcnn.MODEL, spec=voxels))
    targets = detector.preparation.prepare(labelled, None).targets
    maps = taught(targets, voxels, len(voxels.classes))
    boxes = labelled.boxes[np.unique(targets.matched)]
    assert_headings(propose_anchors(maps, voxels, AnchorProposals(nms_iou=0.1)), boxes)
