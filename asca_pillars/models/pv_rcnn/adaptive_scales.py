"""Features of raw points at several scales, adjusted to what is around them (AFE-RCNN, section 3.2: MSAA)."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.models.two_stage.point_mlp import mlp
from asca_pillars.models.two_stage.set_abstraction import SetAbstraction, found_once
from asca_pillars.ops.points.neighbors import PointScale

_SHARE = 4  # by which the impact's hidden layer is narrower, which the paper does not give
_INITIAL_STD = 1e-3  # of the impact's last weights: training starts at features that are hardly adjusted


class Adjustment(nn.Module):
    """F'_i = F_i + MLP(F_i) F_i + sum over the others of MLP(F_i - F_j) (F_i - F_j), channel by channel (eq. 6 to 10).

    What PointWeb (CVPR 2019) calls adaptive feature adjustment.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(channels, max(channels // _SHARE, 1))
        self.out = nn.Linear(self.hidden.out_features, channels)
        nn.init.normal_(self.out.weight, std=_INITIAL_STD)
        nn.init.zeros_(self.out.bias)

    def forward(self, features: Tensor, counted: Tensor) -> Tensor:
        """Unitless features of groups (M, T, C) -> the same shape.

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
    """A feature of each keypoint from groups of points at several scales, the coarse ones interpolated (eq. 11 to 13).

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
        """Points (N, 3 + in_channels), x, y, z in metres, and their scales -> features (K, out_channels)."""
        positions, features, found = points[:, :3], points[:, 3:], []
        for lift, adjust, scale in zip(self.lift, self.adjust, scales, strict=True):
            assert isinstance(lift, SetAbstraction)
            grouped = lift.grouped(positions, features, scale.positions, scale.groups)  # (M, T, C)
            features = adjust(grouped, found_once(scale.groups, positions.shape[0])).max(dim=1).values
            positions = scale.positions
            found.append(features)
        joined = found[-1]
        for finer, scale in zip(found[-2::-1], scales[:0:-1], strict=True):
            joined = torch.cat([finer, _interpolated(joined, scale)], dim=1)
        described: Tensor = self.join(joined)
        return described


def _interpolated(features: Tensor, scale: PointScale[Tensor]) -> Tensor:
    """(M, C) at a scale's positions -> (_, C) at those of the scale before."""
    padded = F.pad(features, (0, 0, 0, 1))
    near = padded.index_select(0, scale.nearest.reshape(-1)).unflatten(0, scale.nearest.shape)
    return (near * scale.nearest_weights[:, :, None]).sum(dim=1)
