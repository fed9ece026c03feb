"""Samples of the second stage as training draws them."""

import numpy as np

from asca_pillars.data.frames import LabeledFrame
from asca_pillars.models.two_stage.preparation import RefineSample, sample_of
from asca_pillars.ops.two_stage.first_stage import SecondStageInputs
from asca_pillars.ops.two_stage.prepare import RefineSettings
from asca_pillars.ops.two_stage.rois import match_proposals, sample_rois


def prepare_sample(
    frame: LabeledFrame, proposed: SecondStageInputs, settings: RefineSettings, rois: int, rng: np.random.Generator
) -> RefineSample:
    """Draw `rois` proposals of a frame and compute their neighbours and targets."""
    overlaps = match_proposals(proposed.proposals, frame.boxes, frame.labels)
    return sample_of(frame, proposed, overlaps, sample_rois(overlaps, rois, rng), settings)
