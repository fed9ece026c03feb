"""Where a keypoint looks for features: shifted by what surrounds it (Deformable PV-RCNN, adaptive deformation)."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.models.two_stage.set_abstraction import found_once

_OFFSET_CHANNELS = 16  # of f', which the paper does not give
_INITIAL_STD = 1e-3  # of the last weights: training starts at almost undeformed keypoints, and all weights learn


class Surroundings(NamedTuple):
    """What stands around K keypoints on one level; index N stands for nothing."""

    features: Tensor
    """(N, C) of the level's voxels."""
    positions: Tensor
    """(N, 3) their centers, metres."""
    keypoints: Tensor
    """(K, 3), metres."""
    indices: Sequence[Tensor]
    """Of each radius (K, T) voxels."""
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
        nn.init.normal_(self.align.weight, std=_INITIAL_STD)

    def forward(self, around: Surroundings) -> list[Tensor]:
        """One list entry (K, 3), metres."""
        assert around.nearest is not None and around.nearest_weights is not None
        index = around.indices[-1]
        offsets = F.pad(self.offset(around.features), (0, 0, 0, 1))  # linear: W (f_i - f_j) = W f_i - W f_j
        own = (_gathered(offsets, around.nearest) * around.nearest_weights[:, :, None]).sum(dim=1)  # (K, 16)
        relative, _ = _relative(around, index)  # v_j - v_i
        found = found_once(index, around.positions.shape[0]).to(own)  # the sum has every neighbor once
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
        """Of each radius (K, 3), metres."""
        shifted = []
        for index in around.indices:
            relative, found = _relative(around, index)
            features = _gathered(F.pad(around.features, (0, 0, 0, 1)), index)
            share = torch.tanh(self.offset(torch.cat([relative, features], dim=2)))
            mean = (share * relative).sum(dim=1) / found.sum(dim=1).clamp(min=1)[:, None]
            shifted.append(around.keypoints + mean)
        return shifted


def _gathered(rows: Tensor, index: Tensor) -> Tensor:
    """(N, C) by (K, T) -> (K, T, C)."""
    return rows.index_select(0, index.reshape(-1)).unflatten(0, index.shape)


def _relative(around: Surroundings, index: Tensor) -> tuple[Tensor, Tensor]:
    """v_j - v_i (K, T, 3), zeros where there is nothing, and whether there is something (K, T)."""
    found = (index < around.positions.shape[0]).to(around.positions.dtype)
    positions = _gathered(F.pad(around.positions, (0, 0, 0, 1)), index)
    return (positions - around.keypoints[:, None]) * found[:, :, None], found
