"""Features of keypoints: voxel set abstraction's raw points and map, and keypoint weighting (PV-RCNN, 3.2, 3.3)."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from asca_pillars.models.two_stage.point_mlp import mlp
from asca_pillars.models.two_stage.set_abstraction import SetAbstraction


class BallSource(NamedTuple):
    """What keypoints aggregate within balls: raw points, or the voxels of a level."""

    channels: int
    """Of a point besides its position."""
    radii: int
    """How many balls around each keypoint."""
    widths: Sequence[int]
    """Of the MLP of each ball."""
    gated: bool = False
    """Whether `ContextGate` chooses among its features."""


class SourceRows(NamedTuple):
    """The points of one source."""

    positions: Tensor
    """(N, 3), metres, in the frame of the keypoints."""
    features: Tensor
    """(N, channels)."""


class ContextGate(nn.Module):
    """g * W_fc f with g = sigmoid(W_gate f + b_gate), channel by channel (Deformable PV-RCNN, context fusion)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.gate = nn.Linear(channels, channels)
        self.value = nn.Linear(channels, channels, bias=False)

    def forward(self, features: Tensor) -> Tensor:
        """Unitless (K, C) -> (K, C)."""
        gated: Tensor = torch.sigmoid(self.gate(features)) * self.value(features)
        return gated


class KeypointEncoder(nn.Module):
    """What lies around a keypoint at several radii, and the first stage's map under it, fused and weighted.

    Args:
        sources: what is aggregated within balls.
        bev_channels: of what is known of a keypoint besides, such as the first stage's map under it.
        out_channels: of the fused feature.
        weighting_channels: of the hidden layers of the weighting.
    """

    def __init__(
        self, sources: Sequence[BallSource], bev_channels: int, out_channels: int, weighting_channels: int
    ) -> None:
        super().__init__()
        self.sources = tuple(sources)
        self.balls = nn.ModuleList(
            SetAbstraction(source.channels, source.widths) for source in sources for _ in range(source.radii)
        )
        channels = [source.radii * source.widths[-1] for source in sources]
        self.gates = nn.ModuleDict(
            {str(number): ContextGate(channels[number]) for number, source in enumerate(sources) if source.gated}
        )
        joined = sum(channels) + bev_channels
        hidden = [weighting_channels, weighting_channels]
        self.fuse = nn.Sequential(*mlp(joined, [out_channels]))
        self.weigh = nn.Sequential(*mlp(joined, hidden), nn.Linear(weighting_channels, 1))
        self.out_channels = out_channels

    def forward(
        self,
        rows: Sequence[SourceRows],
        keypoints: Tensor,
        bev: Tensor,
        indices: Sequence[Tensor],
        centers: Sequence[Tensor] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Weighted features (K, out_channels), and logits (K,) of a keypoint's being part of an object.

        Args:
            rows: of each source.
            keypoints: (K, 3).
            bev: (K, bev_channels) likewise.
            indices: (K, T) rows of the source, source by source and radius by radius.
            centers: (K, 3) of these balls; None where all are the keypoints.
        """
        found, balls = [], iter(zip(self.balls, indices, centers or [keypoints] * len(indices), strict=True))
        for number, (own, source) in enumerate(zip(rows, self.sources, strict=True)):
            of_radii = [
                ball(own.positions, own.features, center, index)
                for ball, index, center in itertools.islice(balls, source.radii)
            ]
            features = torch.cat(of_radii, dim=1)
            found.append(self.gates[str(number)](features) if source.gated else features)
        joined = torch.cat([*found, bev], dim=1)
        logits = self.weigh(joined)
        return self.fuse(joined) * torch.sigmoid(logits), logits[:, 0]
