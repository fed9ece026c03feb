"""Training interface of PV-RCNN (`models.trainable.Trainable`): both stages in one step (paper, section 3.4)."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from asca_pillars.config.pillar import LossConfig
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.proposals import AnchorProposals, propose_anchors
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.models.pillar.loss import detection_loss
from asca_pillars.models.pv_rcnn.layers import FirstStageOutputs, PvRcnn, build_pv_rcnn
from asca_pillars.models.pv_rcnn.preparation import LabeledVoxels, VoxelBatch, VoxelPreparation
from asca_pillars.models.trainable import Trainable
from asca_pillars.models.two_stage.layers import Refinements, zero_of_weights
from asca_pillars.models.two_stage.loss import RefineTargets, distance_iou_loss, refine_loss
from asca_pillars.ops.sparse.rulebooks import stack_rows
from asca_pillars.ops.two_stage.decode import match_proposals, reported_frames, roi_targets, sample_rois
from asca_pillars.ops.two_stage.prepare import grid_neighbors

_DISTANCE_IOU_WEIGHT = 0.3  # alpha of AFE-RCNN's eq. (14)


class PvRcnnOutputs(NamedTuple):
    """Outputs of both stages for B frames."""

    maps: HeadMaps[Tensor]
    """Head maps of the first stage."""
    refinements: Refinements
    """Refinements of `proposals` by the second stage."""
    proposals: tuple[Detections, ...]
    """Proposals of each frame: in training the sampled ones, otherwise all."""


class PvRcnnDetector(Trainable):
    """PV-RCNN with its proposals, targets and loss.

    Args:
        model: its section of the configuration.
        network: made for it.
    """

    preparation: VoxelPreparation

    def __init__(self, model: PvRcnnModel, network: PvRcnn) -> None:
        super().__init__()
        self.model = model
        self.network = network
        self.preparation = VoxelPreparation(model.spec, model.settings)
        self.loss_weights = LossConfig()
        self._kept = () if model.train_first_stage else tuple(getattr(network, name) for name in model.FIRST_STAGE)
        for part in self._kept:
            part.requires_grad_(requires_grad=False)
        self.train()  # Lightning gives back the modes that it found

    def train(self, mode: bool = True) -> "PvRcnnDetector":
        """Set the mode as `torch.nn.Module.train` does; a first stage that is not trained keeps its statistics."""
        super().train(mode)
        for part in self._kept:
            part.eval()
        return self

    def predict(self, batch: LabeledVoxels) -> PvRcnnOutputs:
        """Return head maps, proposals and their refinements; in training, proposals are sampled."""
        scans = batch.scans
        if self.training and min(len(scans.keypoints), *(len(level.cells) for level in scans.levels)) < 2:
            return self._zero_outputs(scans)  # no statistics of a batch
        first = self.network.propose(scans)
        proposals = self._proposals(first.maps, batch)
        with torch.autocast(first.canvas.device.type, enabled=False):  # positions need float32, `SetAbstraction`
            refinements = self._refine(scans, first, proposals)
        return PvRcnnOutputs(first.maps, refinements, proposals)

    def loss(self, outputs: PvRcnnOutputs, batch: LabeledVoxels) -> Mapping[str, Tensor]:
        """Return loss terms of the trained parts by name, see `detection_loss` and `refine_loss`, all of weight 1."""
        device = outputs.refinements.confidence.device
        first = {} if self._kept else detection_loss(outputs.maps, batch.anchors, self.loss_weights)._asdict()
        targets, loss_mask = _roi_targets(outputs.proposals, batch)
        counted = torch.from_numpy(loss_mask).to(device)
        refinements = outputs.refinements
        confidence, positive, residuals, sizes = (torch.from_numpy(part[loss_mask]).to(device) for part in targets)
        targets_in_loss = RefineTargets(confidence, positive, residuals, sizes, batch.keypoint_states)
        kept = Refinements(refinements.confidence[counted], refinements.residuals[counted], refinements.keypoint_logits)
        terms = first | refine_loss(kept, targets_in_loss)._asdict()
        if self.model.box_loss == "va":
            boxes = (kept.residuals[positive].float(), residuals[positive], sizes[positive])
            distance_iou = distance_iou_loss(*boxes).sum() / max(len(boxes[0]), 1)
            terms["distance_iou"] = _DISTANCE_IOU_WEIGHT * distance_iou
        return terms

    def detect(self, outputs: PvRcnnOutputs, spec: DetectorSpec) -> list[Detections]:
        """Return refined boxes of each frame, with the thresholds of `spec`."""
        confidence, residuals = (part.float().cpu().numpy() for part in outputs.refinements[:2])
        return reported_frames(outputs.proposals, confidence, residuals, spec, self.model.scores)

    def _proposals(self, maps: HeadMaps[Tensor], batch: LabeledVoxels) -> tuple[Detections, ...]:
        arrays = [part.detach().float().cpu().numpy() for part in maps]
        settings = self.model.training_proposals if self.training else self.model.settings.proposals
        # From torch's generator, which training sets at every step: a resumed run draws what an unbroken one would.
        rng = np.random.default_rng(int(torch.randint(1 << 62, ()))) if self.training else None
        frames = zip(zip(*arrays, strict=True), batch.scans.frame_keypoints, batch.boxes, batch.labels, strict=True)
        return tuple(
            self._frame_proposals(HeadMaps(*frame), keypoints, settings, boxes, labels, rng)
            for frame, keypoints, boxes, labels in frames
        )

    def _frame_proposals(
        self,
        maps: HeadMaps[NDArray[np.float32]],
        keypoints: int,
        settings: AnchorProposals,
        boxes: NDArray[np.float32],
        labels: NDArray[np.int64],
        rng: np.random.Generator | None,
    ) -> Detections:
        if not keypoints:  # nothing to see, and nothing to judge proposals by
            return Detections.empty(self.model.spec.class_names)
        proposals = propose_anchors(maps, self.model.spec, settings)
        if rng is None:
            return proposals
        return proposals[sample_rois(match_proposals(proposals, boxes, labels), self.model.rois, rng)]

    def _refine(
        self, scans: VoxelBatch[Tensor], first: FirstStageOutputs, proposals: Sequence[Detections]
    ) -> Refinements:
        levels, canvas = [level.float() for level in first.levels], first.canvas.float()
        features, keypoint_logits = self.network.encode_keypoints(scans, levels, canvas)
        if self.training and not sum(map(len, proposals)):
            nothing = zero_of_weights(self.network.refine)
            return Refinements(
                features.new_zeros(0) + nothing, features.new_zeros(0, 7) + nothing, keypoint_logits + nothing
            )
        settings, device = self.model.settings, features.device
        per_frame = np.split(scans.keypoints.cpu().numpy(), np.cumsum(scans.frame_keypoints)[:-1])
        grids = [
            grid_neighbors(keypoints, frame.boxes, settings, settings.vector_cells)
            for keypoints, frame in zip(per_frame, proposals, strict=True)
        ]
        points = torch.from_numpy(np.concatenate([grid.points for grid in grids])).to(device)
        indices = [
            torch.from_numpy(stack_rows([grid.indices[ball] for grid in grids], scans.frame_keypoints)).to(device)
            for ball in range(len(settings.grid_radii_m))
        ]
        confidence, residuals = self.network.refine(scans.keypoints, features, points, indices)
        return Refinements(confidence, residuals, keypoint_logits)

    def _zero_outputs(self, scans: VoxelBatch[Tensor]) -> PvRcnnOutputs:
        """Return zero outputs that give every weight a gradient of zero, as distributed training requires."""
        nothing, frames = zero_of_weights(self), len(scans.frame_keypoints)
        height, width, anchors, _ = self.model.spec.anchors.shape
        classes = len(self.model.spec.classes)
        maps = (nothing.new_zeros(frames, anchors * size, height, width) + nothing for size in (classes, 7, 2))
        refinements = Refinements(
            nothing.new_zeros(0) + nothing,
            nothing.new_zeros(0, 7) + nothing,
            nothing.new_zeros(len(scans.keypoints)) + nothing,
        )
        return PvRcnnOutputs(HeadMaps(*maps), refinements, (Detections.empty(self.model.spec.class_names),) * frames)


def _roi_targets(
    proposals: Sequence[Detections], batch: LabeledVoxels
) -> tuple[tuple[NDArray[np.generic], ...], NDArray[np.bool_]]:
    """Return confidence, positive, residuals, sizes (R, ...) of all proposals, and a mask (R,) of those sampled."""
    parts, loss_mask = [], []
    for frame, boxes, labels in zip(proposals, batch.boxes, batch.labels, strict=True):
        overlaps = match_proposals(frame, boxes, labels)
        targets = roi_targets(frame, boxes, overlaps, np.arange(len(frame)))
        parts.append((targets.confidence, targets.positive, targets.residuals, frame.boxes[:, 3:6]))
        loss_mask.append(~overlaps.ignored)
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True)), np.concatenate(loss_mask)


def build_pv_rcnn_detector(model: PvRcnnModel) -> PvRcnnDetector:
    """Build the detector that `model` describes, with fresh random weights."""
    return PvRcnnDetector(model, build_pv_rcnn(model))
