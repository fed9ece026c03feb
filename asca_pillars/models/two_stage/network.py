"""Training interface of the second stage (`models.trainable.Trainable`); the first stage is separate and frozen."""

from collections.abc import Mapping
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from asca_pillars.base.errors import ConfigError
from asca_pillars.config.two_stage import RefineConfig, RefineModel
from asca_pillars.detection.decode import PostProcess
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.models.trainable import Trainable
from asca_pillars.models.two_stage.layers import (
    BallSource,
    KeypointEncoder,
    PillarRefiner,
    RefineInputs,
    Refinements,
    RoiHead,
    SetAbstraction,
    zero_of_weights,
)
from asca_pillars.models.two_stage.loss import RefineTargets, refine_loss
from asca_pillars.models.two_stage.preparation import (
    LabeledProposals,
    RefinePreparation,
    collate_scans,
    live_preparation,
)
from asca_pillars.ops.two_stage.decode import Scores, refined_detections, refined_scores, reported_frames
from asca_pillars.ops.two_stage.first_stage import SecondStageInputs
from asca_pillars.ops.two_stage.prepare import ROI_FEATURES, RefineSettings, refine_scan

POINT_CHANNELS = 1  # reflectance


class RefineOutputs(NamedTuple):
    """Outputs of the second stage for the proposals of B frames."""

    refinements: Refinements
    proposals: tuple[Detections, ...]
    """Proposals of each frame, which `found` refines."""


class RefineDetector(Trainable):
    """A second stage on the proposals of the first stage that `model` names.

    Args:
        model: its section of the configuration.
        refiner: the network.
    """

    def __init__(self, model: RefineModel, refiner: PillarRefiner) -> None:
        super().__init__()
        self.model = model
        self.refiner = refiner

    @cached_property
    def preparation(self) -> RefinePreparation:  # type: ignore[override]  # made when it is first asked for
        """Runs the first stage on each frame; training reads cached proposals instead (`models.build`).

        Raises:
            AscaError: the first stage cannot be opened, or is not the one of the training.
        """
        return live_preparation(self.model)

    def predict(self, batch: LabeledProposals) -> RefineOutputs:
        """Return confidence and residuals of the proposals of a batch."""
        inputs = batch.inputs
        rows = min(len(inputs.points), len(inputs.keypoints), len(inputs.roi_features))
        if self.training and rows < 2:  # no statistics of a batch, and nothing to learn
            return RefineOutputs(self._zero_outputs(inputs), batch.proposals)
        with torch.autocast(inputs.points.device.type, enabled=False):  # positions need float32, `SetAbstraction`
            refinements: Refinements = self.refiner(inputs)
        return RefineOutputs(refinements, batch.proposals)

    def loss(self, outputs: RefineOutputs, batch: LabeledProposals) -> Mapping[str, Tensor]:
        """Return the terms by name, see `refine_loss`; proposals of IGNORED boxes are left out."""
        refinements, targets, loss_mask = outputs.refinements, batch.targets, batch.loss_mask
        counted = Refinements(
            refinements.confidence[loss_mask], refinements.residuals[loss_mask], refinements.keypoint_logits
        )
        targets_in_loss = RefineTargets(
            targets.confidence[loss_mask],
            targets.positive[loss_mask],
            targets.residuals[loss_mask],
            targets.sizes[loss_mask],
            targets.keypoint_states,
        )
        return refine_loss(counted, targets_in_loss)._asdict()

    def detect(self, outputs: RefineOutputs, spec: DetectorSpec) -> list[Detections]:
        """Return refined boxes of each frame, with the thresholds of `spec`."""
        confidence, residuals = (part.float().cpu().numpy() for part in outputs.refinements[:2])
        return reported_frames(outputs.proposals, confidence, residuals, spec, self.model.refine.scores)

    def _zero_outputs(self, inputs: RefineInputs) -> Refinements:
        """Return zero outputs that give every weight a gradient of zero, as distributed training requires."""
        nothing = zero_of_weights(self)
        rois, keypoints = len(inputs.roi_features), len(inputs.keypoints)
        zeros = inputs.points.new_zeros
        return Refinements(zeros(rois) + nothing, zeros(rois, 7) + nothing, zeros(keypoints) + nothing)


def build_refine_detector(model: RefineModel) -> RefineDetector:
    """Build the network that `model` describes, with fresh random weights.

    Raises:
        ConfigError: it lacks the number of channels of the first stage's map.
    """
    if not model.bev_channels:
        raise ConfigError(
            f"model.bev_channels = 0: not yet read from {model.first_stage}; `asca train` does, "
            "`models.two_stage.first_stage.with_first_stage` elsewhere"
        )
    return RefineDetector(model, build_refiner(model.bev_channels, len(model.spec.classes), model.refine))


def build_refiner(bev_channels: int, classes: int, refine: RefineConfig) -> PillarRefiner:
    """Build a second stage with fresh random weights."""
    network, neighbors = refine.network, refine.neighbors
    return PillarRefiner(
        KeypointEncoder(
            [BallSource(POINT_CHANNELS, len(neighbors.ball_radii_m), network.ball_widths)],
            bev_channels,
            network.keypoint_channels,
            weighting_channels=network.keypoint_channels,
        ),
        RoiHead(
            [SetAbstraction(network.keypoint_channels, network.grid_widths) for _ in neighbors.grid_radii_m],
            neighbors.grid_size,
            roi_channels=classes + ROI_FEATURES,
            hidden=network.hidden,
            dropout=network.dropout,
        ),
    )


def refine(
    network: PillarRefiner,
    points: NDArray[np.float32],
    proposed: SecondStageInputs,
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
    confidence, residuals = refine_logits(network, points, proposed, settings)
    values = refined_scores(proposed.proposals, confidence, scores)
    return refined_detections(proposed.proposals, values, residuals, post)


def refine_logits(
    network: PillarRefiner, points: NDArray[np.float32], proposed: SecondStageInputs, settings: RefineSettings
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return confidence logits (R,) and residuals (R, 7) of the proposals of one scan, see `refine`."""
    if not len(proposed.proposals):
        return np.empty(0, np.float32), np.empty((0, 7), np.float32)
    inputs = collate_scans([refine_scan(points, proposed, proposed.proposals, settings)])
    with torch.inference_mode():
        refinements = network(inputs)
    return refinements.confidence.numpy(), refinements.residuals.numpy()
