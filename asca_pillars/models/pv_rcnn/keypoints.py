"""Extensions of PV-RCNN's keypoint features: adaptive scales (AFE-RCNN, 3.2) and adaptive deformation."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.models.two_stage.sets import SetAbstraction, first_occurrences, mlp
from asca_pillars.ops.points.neighbors import PointScale

_SHARE = 4  # by which the impact's hidden layer is narrower, which the paper does not give
_INITIAL_STD = 1e-3  # std of the last layer's initial weights: training starts at nearly unadjusted features


class Adjustment(nn.Module):
    """F'_i = F_i + MLP(F_i) F_i + sum over the others of MLP(F_i - F_j) (F_i - F_j), channel by channel (eq. 6 to 10).

    PointWeb (CVPR 2019) calls it adaptive feature adjustment.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(channels, max(channels // _SHARE, 1))
        self.out = nn.Linear(self.hidden.out_features, channels)
        nn.init.normal_(self.out.weight, std=_INITIAL_STD)
        nn.init.zeros_(self.out.bias)

    def forward(self, features: Tensor, counted: Tensor) -> Tensor:
        """Adjust unitless features of groups (M, T, C) -> the same shape.

        Args:
            features: F.
            counted: (M, T) 1 for the members of each group, 0 for what only fills it.
        """
        own = features * (1 + self.out(torch.relu(self.hidden(features))))
        difference = features[:, :, None] - features[:, None]  # (M, T, T, C): F_i - F_j, zero where i is j
        # The hidden layer is linear before its ReLU: W (F_i - F_j) + b = W F_i - W F_j + b.
        within = F.linear(features, self.hidden.weight)
        impact = self.out(torch.relu(within[:, :, None] - within[:, None] + self.hidden.bias))
        return own + (impact * difference * counted[:, None, :, None]).sum(dim=2)


class AdaptiveScales(nn.Module):
    """Keypoint features from groups of points at several scales, the coarse ones interpolated (eq. 11 to 13).

    Args:
        in_channels: of a raw point besides its position.
        widths: channels of each scale, the finest first.
        out_channels: of a keypoint.
    """

    def __init__(self, in_channels: int, widths: Sequence[int], out_channels: int) -> None:
        super().__init__()
        inputs = [in_channels, *widths[:-1]]
        self.lift = nn.ModuleList(SetAbstraction(read, (width,)) for read, width in zip(inputs, widths, strict=True))
        self.adjust = nn.ModuleList(Adjustment(width) for width in widths)
        self.join = nn.Sequential(*mlp(sum(widths), [out_channels]))
        self.out_channels = out_channels

    def forward(self, points: Tensor, scales: Sequence[PointScale[Tensor]]) -> Tensor:
        """Encode points (N, 3 + in_channels), x, y, z in metres, and their scales -> features (K, out_channels)."""
        positions, features, found = points[:, :3], points[:, 3:], []
        for lift, adjust, scale in zip(self.lift, self.adjust, scales, strict=True):
            assert isinstance(lift, SetAbstraction)
            grouped = lift.grouped(positions, features, scale.positions, scale.groups)  # (M, T, C)
            features = adjust(grouped, first_occurrences(scale.groups, positions.shape[0])).max(dim=1).values
            positions = scale.positions
            found.append(features)
        joined = found[-1]
        for finer, scale in zip(found[-2::-1], scales[:0:-1], strict=True):
            joined = torch.cat([finer, _interpolated(joined, scale)], dim=1)
        described: Tensor = self.join(joined)
        return described


def _interpolated(features: Tensor, scale: PointScale[Tensor]) -> Tensor:
    """Interpolate (M, C) at a scale's positions -> (_, C) at those of the scale before."""
    padded = F.pad(features, (0, 0, 0, 1))
    near = padded.index_select(0, scale.nearest.reshape(-1)).unflatten(0, scale.nearest.shape)
    return (near * scale.nearest_weights[:, :, None]).sum(dim=1)


_OFFSET_CHANNELS = 16  # channels of f', which the paper does not give
_ALIGN_STD = 1e-3  # std of the last initial weights: training starts at almost undeformed keypoints, with gradients


class Surroundings(NamedTuple):
    """Neighbors of K keypoints on one level; index N stands for none."""

    features: Tensor
    """(N, C) of the level's voxels."""
    positions: Tensor
    """(N, 3) their centers, metres."""
    keypoints: Tensor
    """(K, 3), metres."""
    indices: Sequence[Tensor]
    """(K, T) voxels per radius."""
    nearest: Tensor | None = None
    """(K, 3) the three nearest voxels."""
    nearest_weights: Tensor | None = None
    """(K, 3) inverse distances, sum 1."""


class PaperDeformation(nn.Module):
    """v_i + tanh(W_align ReLU(mean_j W_offset (f_i - f_j) (v_i - v_j)^T)), one place for all radii of a level.

    j are the voxels of the last, largest ball; f_i is the mean of the three nearest voxels by inverse distance.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.offset = nn.Linear(channels, _OFFSET_CHANNELS, bias=False)
        self.align = nn.Linear(_OFFSET_CHANNELS * 3, 3, bias=False)
        nn.init.normal_(self.align.weight, std=_ALIGN_STD)

    def forward(self, around: Surroundings) -> list[Tensor]:
        """Return a list of one entry (K, 3), metres."""
        assert around.nearest is not None and around.nearest_weights is not None
        index = around.indices[-1]
        offsets = F.pad(self.offset(around.features), (0, 0, 0, 1))  # linear: W (f_i - f_j) = W f_i - W f_j
        own = (_gathered(offsets, around.nearest) * around.nearest_weights[:, :, None]).sum(dim=1)  # (K, 16)
        relative, _ = _relative(around, index)  # v_j - v_i
        found = first_occurrences(index, around.positions.shape[0]).to(own)  # the sum has every neighbor once
        difference = (own[:, None] - _gathered(offsets, index)) * found[:, :, None]
        mean = difference.transpose(1, 2) @ -relative / found.sum(dim=1).clamp(min=1)[:, None, None]  # (K, 16, 3)
        return [around.keypoints + torch.tanh(self.align(torch.relu(mean).flatten(1)))]


class AuthorsDeformation(nn.Module):
    """v_i + mean_j tanh(W [v_j - v_i ; f_j]) * (v_j - v_i), a place for each radius, as in the authors' code.

    There the mean is over a whole ball's row, in which a neighbor that fills it counts again and again.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.offset = nn.Linear(3 + channels, 3, bias=False)

    def forward(self, around: Surroundings) -> list[Tensor]:
        """Return (K, 3) per radius, metres."""
        shifted = []
        for index in around.indices:
            relative, found = _relative(around, index)
            features = _gathered(F.pad(around.features, (0, 0, 0, 1)), index)
            share = torch.tanh(self.offset(torch.cat([relative, features], dim=2)))
            mean = (share * relative).sum(dim=1) / found.sum(dim=1).clamp(min=1)[:, None]
            shifted.append(around.keypoints + mean)
        return shifted


def _gathered(rows: Tensor, index: Tensor) -> Tensor:
    """Gather (N, C) by (K, T) -> (K, T, C)."""
    return rows.index_select(0, index.reshape(-1)).unflatten(0, index.shape)


def _relative(around: Surroundings, index: Tensor) -> tuple[Tensor, Tensor]:
    """Return v_j - v_i (K, T, 3), zeros for empty entries, and a mask of the others (K, T)."""
    found = (index < around.positions.shape[0]).to(around.positions.dtype)
    positions = _gathered(F.pad(around.positions, (0, 0, 0, 1)), index)
    return (positions - around.keypoints[:, None]) * found[:, :, None], found
