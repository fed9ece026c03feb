"""The second stage at work on single scans in PyTorch."""

import numpy as np
import torch
from numpy.typing import NDArray

from asca_pillars.detection.decode import PostProcess
from asca_pillars.detection.detections import Detections
from asca_pillars.models.two_stage.pillar_refiner import PillarRefiner
from asca_pillars.models.two_stage.samples import collate_scans
from asca_pillars.ops.two_stage.decode import Scores, refined_detections, refined_scores
from asca_pillars.ops.two_stage.first_stage import Proposed
from asca_pillars.ops.two_stage.prepare import RefineSettings, refine_scan


def refine(
    network: PillarRefiner,
    points: NDArray[np.float32],
    proposed: Proposed,
    settings: RefineSettings,
    post: PostProcess,
    scores: Scores,
) -> Detections:
    """Refine the proposals of one scan (N, 4); a scan without any has no detections.

    Args:
        network: in evaluation mode, on the CPU.
        post: suppression among the refined boxes.
        scores: of the refined boxes.
    """
    confidence, residuals = judge(network, points, proposed, settings)
    values = refined_scores(proposed.proposals, confidence, scores)
    return refined_detections(proposed.proposals, values, residuals, post)


def judge(
    network: PillarRefiner, points: NDArray[np.float32], proposed: Proposed, settings: RefineSettings
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Confidence logits (R,) and residuals (R, 7) of the proposals of one scan, see `refine`."""
    if not len(proposed.proposals):
        return np.empty(0, np.float32), np.empty((0, 7), np.float32)
    inputs = collate_scans([refine_scan(points, proposed, proposed.proposals, settings)])
    with torch.inference_mode():
        found = network(inputs)
    return found.confidence.numpy(), found.residuals.numpy()
