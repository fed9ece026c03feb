"""A small PV-RCNN with random weights, and scans to calibrate with."""

import dataclasses

import torch
from torch import nn

from asca_pillars.models.build import Checkpoint
from tests.export.tiny import SCANS
from tests.models.pv_rcnn.tiny_pv_rcnn import MODEL, SPEC, batch, frame, tiny_config, tiny_detector

CALIBRATION = [points[:-1] for points in SCANS]  # ranges of random weights differ much from scene to scene


def random_checkpoint() -> Checkpoint:
    """Random weights, normalized on two scans, that are sure enough of some boxes."""
    detector = tiny_detector()
    for module in detector.modules():
        if isinstance(module, (nn.BatchNorm1d, nn.BatchNorm2d)):
            module.momentum = 1.0
    scans = batch(detector, frame(50), frame(51)).scans
    with torch.no_grad():
        first = detector.network.train().propose(scans)
        detector.network.encode_keypoints(scans, first.levels, first.canvas)
        for part in (detector.network.head.scores, detector.network.head.boxes):
            part.weight.normal_(0, 0.02)
    model = dataclasses.replace(MODEL, spec=SPEC.with_score_threshold(0.02))
    return Checkpoint(tiny_config(model), detector.eval(), 0)
