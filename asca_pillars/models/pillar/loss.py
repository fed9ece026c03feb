"""The training loss: eq. (13)-(15) of the paper, with the residuals of PointPillars."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.config.pillar import LossConfig
from asca_pillars.detection.anchors import ANCHOR_YAWS_RAD
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.geometry.boxes import decode_boxes
from asca_pillars.geometry.overlap import paired_iou_3d


class TargetBatch(NamedTuple):
    """`detection.targets.Targets` of B frames.

    Attributes:
        state: (B, H, W, A) int8, 1 positive, 0 negative, -1 without part.
        positives: (n,) flat indices into (B, H, W, A).
        anchors: (n, 7), LiDAR frame.
        residuals: (n, 7).
        directions: (n,) int64.
    """

    state: Tensor
    positives: Tensor
    anchors: Tensor
    residuals: Tensor
    directions: Tensor


class LossTerms(NamedTuple):
    """Weighted terms of the loss, scalars; their sum is eq. (15)."""

    box: Tensor
    classification: Tensor
    direction: Tensor

    @property
    def total(self) -> Tensor:
        """Total loss, eq. (15), a scalar."""
        return self.box + self.classification + self.direction


def detection_loss(maps: HeadMaps[Tensor], targets: TargetBatch, config: LossConfig) -> LossTerms:
    """Compute eq. (15): focal loss over anchors, smooth L1 and direction over the positive ones, per positive anchor.

    Args:
        maps: scores (B, A, H, W), or (B, A * classes, H, W), boxes (B, 7A, H, W), directions (B, 2A, H, W); or rows
            (M, A), (M, 7A), (M, 2A) at active head cells.
        targets: what they should be; of rows those that `targets_at` returns.
        config: weights and shape parameters.
    """
    positives = max(len(targets.positives), 1)
    states = states_by_class(targets.state, maps.scores.shape[1] // targets.state.shape[-1])
    logits = _by_anchor(maps.scores, values=states.shape[1]).float()
    residuals = _by_anchor(maps.boxes, values=7)[targets.positives].float()
    if config.score_target == "one":
        classification = focal_loss(logits, states, config.focal_alpha, config.focal_gamma)
    else:
        quality = logits.new_zeros(len(logits), 1)
        quality[targets.positives, 0] = predicted_ious(residuals, targets)
        classification = quality_focal_loss(logits, states, quality, config.focal_alpha, config.focal_gamma)
    directions = _by_anchor(maps.directions, values=2)[targets.positives].float()
    box = box_loss(residuals, targets.residuals, config.smooth_l1_beta)
    direction = F.cross_entropy(directions, targets.directions, reduction="sum")
    return LossTerms(
        config.box_weight * box / positives,
        config.class_weight * classification / positives,
        config.direction_weight * direction / positives,
    )


def states_by_class(state: Tensor, scores: int) -> Tensor:
    """Return the training state of each class logit: (..., A) -> (anchors, scores), as `TargetBatch.state`.

    With one score it is the anchor's own. With one for each class a positive anchor is a negative of the others.
    """
    states = state.reshape(-1, 1)
    if scores == 1:
        return states
    anchor_class = torch.arange(state.shape[-1], device=state.device) // len(ANCHOR_YAWS_RAD)
    is_own = anchor_class[:, None] == torch.arange(scores, device=state.device)  # (A, scores)
    is_own = is_own.expand(len(states) // len(anchor_class), -1, -1).flatten(0, 1)
    return torch.where((states == 1) & ~is_own, torch.zeros_like(states), states)


def targets_at(targets: TargetBatch, cells: Tensor) -> TargetBatch:
    """Return the targets of the anchors at M active head cells; the loss ignores others.

    Args:
        targets: of whole maps.
        cells: (M,) flat index into (B, H, W), ascending.

    Returns:
        `state` is (M, A), and `positives` are flat indices into it.
    """
    anchors = targets.state.shape[-1]
    rows = targets.state.new_full((targets.state[..., 0].numel(),), -1, dtype=torch.int64)
    rows[cells.long()] = torch.arange(len(cells), device=cells.device)
    row = rows[targets.positives // anchors]
    active = row >= 0
    return TargetBatch(
        targets.state.view(-1, anchors)[cells.long()],
        (row * anchors + targets.positives % anchors)[active],
        targets.anchors[active],
        targets.residuals[active],
        targets.directions[active],
    )


def focal_loss(logits: Tensor, state: Tensor, alpha: float, gamma: float) -> Tensor:
    """Compute eq. (14), summed: binary focal loss (arXiv 1708.02002) where `state` is 1 or 0, nothing where it is -1.

    Both are (B, H, W, A); the loss is a scalar.
    """
    target = (state == 1).to(logits.dtype)
    cross_entropy = F.binary_cross_entropy_with_logits(logits, target, reduction="none")
    miss = torch.where(state == 1, torch.sigmoid(-logits), torch.sigmoid(logits))
    weight = torch.where(state == 1, alpha, 1 - alpha) * (state >= 0)
    return (weight * miss**gamma * cross_entropy).sum()


def quality_focal_loss(logits: Tensor, state: Tensor, quality: Tensor, alpha: float, gamma: float) -> Tensor:
    """Compute eq. (2) of Generalized Focal Loss (arXiv 2006.04388), summed: `quality` is the target of positives.

    With eq. (14)'s weights of positive and negative anchors, which that paper leaves out: where every quality is 1 this
    is `focal_loss`.

    Args:
        logits, state: (anchors, scores), as of `focal_loss`.
        quality: (anchors, 1) in [0, 1].
        alpha, gamma: as of `focal_loss`; gamma is the paper's beta.
    """
    target = torch.where(state == 1, quality, torch.zeros_like(quality))
    cross_entropy = F.binary_cross_entropy_with_logits(logits, target, reduction="none")
    weight = torch.where(state == 1, alpha, 1 - alpha) * (state >= 0)
    return (weight * (target - torch.sigmoid(logits)).abs() ** gamma * cross_entropy).sum()


def predicted_ious(residuals: Tensor, targets: TargetBatch) -> Tensor:
    """Return the 3D IoU of positive anchors' predicted boxes with their targets: (n, 7) -> (n,), without gradient."""
    anchors, directions = targets.anchors.cpu().numpy(), targets.directions.cpu().numpy()
    with np.errstate(over="ignore", invalid="ignore"):  # an overflowing box overlaps nothing
        # Half a turn changes no overlap, so the direction that is predicted does not matter.
        predicted, target = (
            decode_boxes(encoded.detach().cpu().numpy(), directions, anchors).astype(np.float64)
            for encoded in (residuals, targets.residuals)
        )
        return torch.from_numpy(paired_iou_3d(predicted, target)).to(residuals)


def box_loss(residuals: Tensor, targets: Tensor, beta: float, weights: Tensor | float = 1.0) -> Tensor:
    """Compute eq. (13), summed over residuals (K, 7): smooth L1 of six of them and of the sine of the yaw difference.

    The sine makes a box and the same box turned by half a circle equal; the direction bins tell them apart.
    `weights`, (K, 1), are those of the boxes.
    """
    sine = torch.sin(residuals[:, 6:] - targets[:, 6:])
    errors = torch.cat([residuals[:, :6] - targets[:, :6], sine], dim=1)
    return (weights * F.smooth_l1_loss(errors, torch.zeros_like(errors), beta=beta, reduction="none")).sum()


FOREGROUND_SCORE = 0.1
"""Lowest score of a teacher's anchor whose box and direction are learnt; all others together would outweigh them."""


class DistillationTerms(NamedTuple):
    """Weighted terms of `distillation_loss`, scalars."""

    teacher_box: Tensor
    teacher_classification: Tensor
    teacher_direction: Tensor


def distillation_loss(maps: HeadMaps[Tensor], teacher: HeadMaps[Tensor], config: LossConfig) -> DistillationTerms:
    """Compute how far head maps are from those of a trained detector (arXiv 1503.02531), with the weights of `config`.

    The teacher's score is the target of every anchor's score in the quality focal loss (arXiv 2006.04388), without
    alpha, because no anchor is positive or negative. Where it is at least FOREGROUND_SCORE it is also the weight with
    which the teacher's box and direction are learnt. All terms are divided by the sum of these scores.

    Args:
        maps: of the detector that learns; whole maps or rows, as of `detection_loss`.
        teacher: of the same anchors.
        config: weights and shape parameters.
    """
    logits, scores = _by_anchor(maps.scores, values=1).float(), torch.sigmoid(_by_anchor(teacher.scores, 1).float())
    cross_entropy = F.binary_cross_entropy_with_logits(logits, scores, reduction="none")
    classification = (scores - torch.sigmoid(logits)).abs() ** config.focal_gamma * cross_entropy
    foreground = scores[:, 0] >= FOREGROUND_SCORE
    weights = scores[foreground]
    total = weights.sum().clamp(min=1.0)
    residuals, teacher_residuals = (
        _by_anchor(outputs.boxes, values=7)[foreground].float() for outputs in (maps, teacher)
    )
    directions, bins = (_by_anchor(outputs.directions, values=2)[foreground].float() for outputs in (maps, teacher))
    box = box_loss(residuals, teacher_residuals, config.smooth_l1_beta, weights)
    direction = weights[:, 0] * F.cross_entropy(directions, torch.softmax(bins, dim=1), reduction="none")
    return DistillationTerms(
        config.box_weight * box / total,
        config.class_weight * classification.sum() / total,
        config.direction_weight * direction.sum() / total,
    )


def _by_anchor(maps: Tensor, values: int) -> Tensor:
    """Reshape (B, A * values, H, W) or (M, A * values) to (anchors, values), in the order of the targets."""
    rows = maps if maps.ndim == 2 else maps.permute(0, 2, 3, 1)
    return rows.reshape(-1, values)
