"""The second stage at work on single scans in PyTorch."""

import numpy as np
import torch
from numpy.typing import NDArray

from asca_pillars.geometry.decode import PostProcess
from asca_pillars.geometry.detections import Detections
from asca_pillars.models.refine.pillar_refiner import PillarRefiner
from asca_pillars.points.refined_detections import refined_detections
from asca_pillars.second_stage.first_stage import Proposed
from asca_pillars.second_stage.refine_geometry import RefineSettings, refine_scan
from asca_pillars.second_stage.refine_sample import collate_scans


def refine(
    network: PillarRefiner,
    points: NDArray[np.float32],
    proposed: Proposed,
    settings: RefineSettings,
    post: PostProcess,
) -> Detections:
    """Refine the proposals of one scan (N, 4); a scan without any has no detections.

    Args:
        network: in evaluation mode, on the CPU.
        post: suppression among the refined boxes.
    """
    proposals = proposed.proposals
    if not len(proposals):
        return proposals
    inputs = collate_scans([refine_scan(points, proposed, proposals, settings)])
    with torch.inference_mode():
        found = network(inputs)
    scores = torch.sigmoid(found.confidence).numpy()
    return refined_detections(proposals, scores, found.residuals.numpy(), post)
