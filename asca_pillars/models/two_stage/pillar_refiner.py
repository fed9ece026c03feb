"""The second stage on a pillar detector's proposals: PV-RCNN without its voxel branch."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from asca_pillars.models.two_stage.keypoint_encoder import KeypointEncoder, SourceRows
from asca_pillars.models.two_stage.roi_head import RoiHead


class RefineInputs(NamedTuple):
    """Points, keypoints and proposals of B frames, one frame's after the other's; indices count through the batch."""

    points: Tensor
    """(N, 4) x, y, z in metres, LiDAR frame, and reflectance."""
    keypoints: Tensor
    """(K, 3)."""
    bev: Tensor
    """(K, C) the first stage's map at the keypoints, see `bilinear_cells`."""
    ball_indices: tuple[Tensor, ...]
    """Of each radius (K, T) points around the keypoints; N stands for nothing."""
    grid_points: Tensor
    """(R * cells, 3) of the proposals."""
    grid_indices: tuple[Tensor, ...]
    """Of each radius (R * cells, T) keypoints around the grid points; K stands for nothing."""
    roi_features: Tensor
    """(R, F) what else is known of each proposal."""


class Refinements(NamedTuple):
    """What the second stage says of R proposals and K keypoints."""

    confidence: Tensor
    """(R,) logits."""
    residuals: Tensor
    """(R, 7), see `ops.two_stage.rois`."""
    keypoint_logits: Tensor
    """(K,) of a keypoint's being part of an object."""


def zero_of_weights(module: nn.Module) -> Tensor:
    """A scalar 0 from which every weight has a gradient of zero."""
    return 0 * torch.stack([weight.sum() for weight in module.parameters()]).sum()


class PillarRefiner(nn.Module):
    """Keypoints from raw points and the first stage's map; RoI-grid pooling; confidence and residuals."""

    def __init__(self, encode: KeypointEncoder, head: RoiHead) -> None:
        super().__init__()
        self.encode = encode
        self.head = head

    def forward(self, inputs: RefineInputs) -> Refinements:
        """See `RefineInputs` and `Refinements`."""
        points = SourceRows(inputs.points[:, :3], inputs.points[:, 3:])
        features, logits = self.encode([points], inputs.keypoints, inputs.bev, inputs.ball_indices)
        confidence, residuals = self.head(
            inputs.keypoints, features, inputs.grid_points, inputs.grid_indices, inputs.roi_features
        )
        return Refinements(confidence, residuals, logits)
