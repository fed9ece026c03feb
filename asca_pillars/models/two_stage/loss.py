"""The loss of the second stage (PV-RCNN, section 3.4): confidence, residuals, corners, keypoints."""

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.models.pillar.loss import focal_loss
from asca_pillars.models.two_stage.layers import Refinements

_RESIDUAL_BETA, _CORNER_BETA = 1 / 9, 1.0
_FOCAL_ALPHA, _FOCAL_GAMMA = 0.25, 2.0
# Share of the keypoints that the focal loss is divided by at least. PV-RCNN divides by the positive ones whatever their
# number; keypoints that stand near proposals alone can all be negative, and such a batch would outweigh all others.
_LEAST_POSITIVE = 0.01


class RefineTargets(NamedTuple):
    """Training targets of the second stage; R proposals, K keypoints."""

    confidence: Tensor
    """(R,) in [0, 1]."""
    positive: Tensor
    """(R,) bool, the proposals that learn residuals."""
    residuals: Tensor
    """(R, 7)."""
    sizes: Tensor
    """(R, 3) length, width, height of the proposals, metres."""
    keypoint_states: Tensor
    """(K,) int8: 1 in an object, 0 outside, -1 takes no part."""


class RefineTerms(NamedTuple):
    """Terms of the loss, scalars, each with weight 1."""

    confidence: Tensor
    residuals: Tensor
    corners: Tensor
    keypoints: Tensor

    @property
    def total(self) -> Tensor:
        """Their sum."""
        return self.confidence + self.residuals + self.corners + self.keypoints


def refine_loss(refinements: Refinements, targets: RefineTargets) -> RefineTerms:
    """Compute BCE per proposal, smooth L1 and corners per positive proposal, focal loss per positive keypoint."""
    confidence = F.binary_cross_entropy_with_logits(refinements.confidence.float(), targets.confidence, reduction="sum")
    positive = targets.positive
    residuals, target = refinements.residuals.float()[positive], targets.residuals[positive]
    positives = max(len(target), 1)
    corners = corner_loss(residuals, target, targets.sizes[positive])
    states = targets.keypoint_states
    keypoints = focal_loss(refinements.keypoint_logits.float(), states, _FOCAL_ALPHA, _FOCAL_GAMMA)
    in_objects = max(int((states == 1).sum()), round(_LEAST_POSITIVE * len(states)), 1)
    return RefineTerms(
        confidence / max(len(positive), 1),
        F.smooth_l1_loss(residuals, target, beta=_RESIDUAL_BETA, reduction="sum") / positives,
        corners.sum() / positives,
        keypoints / in_objects,
    )


def corner_loss(residuals: Tensor, targets: Tensor, sizes: Tensor) -> Tensor:
    """Return the mean smooth L1 distance of the eight corners: (R, 7), (R, 7), (R, 3) -> (R,).

    Corners are in the frames of the proposals, which have these sizes. Each is compared with the nearer one of the
    target box and of the same box turned by half a circle.
    """
    predicted, target = corners_in_frames(residuals, sizes), corners_in_frames(targets, sizes)
    half_turn = torch.zeros_like(targets)
    half_turn[:, 6] = math.pi
    turned = corners_in_frames(targets + half_turn, sizes)
    way_m = torch.minimum((predicted - target).norm(dim=2), (predicted - turned).norm(dim=2))  # (R, 8)
    return F.smooth_l1_loss(way_m, torch.zeros_like(way_m), beta=_CORNER_BETA, reduction="none").mean(dim=1)


def distance_iou_loss(residuals: Tensor, targets: Tensor, sizes: Tensor) -> Tensor:
    """1 - IoU + (distance of the centers / diagonal of the box around both)^2, in bird's-eye view (AFE-RCNN, eq. 17).

    Both boxes as rectangles along the axes of their proposals, which have these sizes: (R, 7), (R, 7), (R, 3) -> (R,).
    """
    (center, half), (target, target_half) = (_boxes_in_frames(encoded, sizes) for encoded in (residuals, targets))
    ends = [
        (at[:, :2] - reach[:, :2], at[:, :2] + reach[:, :2]) for at, reach in ((center, half), (target, target_half))
    ]
    (low, high), (wanted_low, wanted_high) = ends
    shared = (torch.minimum(high, wanted_high) - torch.maximum(low, wanted_low)).clamp(min=0).prod(dim=1)
    union = 4 * (half[:, :2].prod(dim=1) + target_half[:, :2].prod(dim=1)) - shared
    around = torch.maximum(high, wanted_high) - torch.minimum(low, wanted_low)
    apart = (center - target)[:, :2].square().sum(dim=1)
    return 1 - shared / union + apart / around.square().sum(dim=1)


def corners_in_frames(residuals: Tensor, sizes: Tensor) -> Tensor:
    """Return corners of refined boxes, seen from their proposals of these sizes: (R, 7), (R, 3) -> (R, 8, 3) metres.

    The order is that of `geometry.boxes.corners`; residuals as in `ops.two_stage.decode`.
    """
    center, half = _boxes_in_frames(residuals, sizes)
    signs = half.new_tensor([[1, 1], [-1, 1], [-1, -1], [1, -1]]).tile(2, 1)  # (8, 2)
    along, across = signs[:, 0] * half[:, 0:1], signs[:, 1] * half[:, 1:2]  # (R, 8)
    cos, sin = torch.cos(residuals[:, 6:]), torch.sin(residuals[:, 6:])
    up = half.new_tensor([-1.0] * 4 + [1.0] * 4) * half[:, 2:3]
    return torch.stack([cos * along - sin * across, sin * along + cos * across, up], dim=2) + center[:, None]


def _boxes_in_frames(residuals: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor]:
    """Return centers and half sizes of refined boxes in the proposals' frames: (R, 7), (R, 3) -> 2 x (R, 3) metres."""
    diagonal = torch.hypot(sizes[:, 0], sizes[:, 1])
    center = torch.stack([residuals[:, 0] * diagonal, residuals[:, 1] * diagonal, residuals[:, 2] * sizes[:, 2]], dim=1)
    # Held as `decode_boxes` holds them: an untrained head must not make corners that are not finite.
    return center, sizes * residuals[:, 3:6].clamp(-math.log(100.0), math.log(100.0)).exp() / 2
