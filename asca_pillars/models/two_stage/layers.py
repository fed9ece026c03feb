"""The second stage: keypoints and their features, RoI-grid pooling, confidence and residuals (PV-RCNN, 3.2 to 3.4)."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from asca_pillars.models.two_stage.sets import SetAbstraction, VectorPool, mlp


class BallSource(NamedTuple):
    """Source that keypoints aggregate within balls: raw points, or the voxels of a level."""

    channels: int
    """Channels of a point besides its position."""
    radii: int
    """Number of balls around each keypoint."""
    widths: Sequence[int]
    """Widths of the MLP of each ball."""
    gated: bool = False
    """True if its features pass through `ContextGate`."""


class SourceRows(NamedTuple):
    """Points of one source."""

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
        """Apply the gate: unitless (K, C) -> (K, C)."""
        gated: Tensor = torch.sigmoid(self.gate(features)) * self.value(features)
        return gated


class KeypointEncoder(nn.Module):
    """Keypoint features: balls of several radii and the first stage's map at the keypoint, fused and weighted.

    Args:
        sources: what is aggregated within balls.
        bev_channels: of a keypoint's other features, such as the first stage's map at its position.
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
        """Return weighted features (K, out_channels) of keypoints, and foreground logits (K,).

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


class RoiHead(nn.Module):
    """RoI-grid pooling of keypoints, and the heads of confidence and residuals.

    Args:
        pools: what aggregates the keypoints around a grid point, one for each radius.
        grid_size: grid points along each axis of a box.
        roi_channels: of what is known of a proposal besides, appended to its pooled features.
        hidden: channels of the fully connected layers.
        dropout: between them.
    """

    def __init__(
        self,
        pools: Sequence[SetAbstraction | VectorPool],
        grid_size: int,
        roi_channels: int,
        hidden: int,
        dropout: float,
    ) -> None:
        super().__init__()
        self.cells = grid_size**3
        self.pools = nn.ModuleList(pools)
        pooled = sum(pool.out_channels for pool in pools)
        self.shared = nn.Sequential(*mlp(self.cells * pooled, [hidden, hidden], dropout))
        joined = hidden + roi_channels
        self.confidence = nn.Sequential(*mlp(joined, [hidden, hidden], dropout), nn.Linear(hidden, 1))
        self.residuals = nn.Sequential(*mlp(joined, [hidden, hidden], dropout), nn.Linear(hidden, 7))
        # An untrained head leaves proposals where they are.
        nn.init.normal_(self.residuals[-1].weight, std=0.001)  # type: ignore[arg-type]
        nn.init.zeros_(self.residuals[-1].bias)  # type: ignore[arg-type]

    def forward(
        self,
        keypoints: Tensor,
        features: Tensor,
        grid_points: Tensor,
        indices: Sequence[Tensor],
        roi_features: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return confidence logits (R,) and residuals (R, 7), see `encode_refinement`.

        Args:
            keypoints: (K, 3).
            features: (K, C).
            grid_points: (R * cells, 3), see `roi_grid_points`.
            indices: of each radius (R * cells, T) or, for VectorPool, (R * cells, T, 3) keypoints.
            roi_features: (R, roi_channels); None where there are no such channels.
        """
        pooled = [
            pool(keypoints, features, grid_points, index) for pool, index in zip(self.pools, indices, strict=True)
        ]
        grid = torch.cat(pooled, dim=1)  # (R * cells, C)
        shared = self.shared(grid.reshape(-1, self.cells * grid.shape[1]))
        joined = shared if roi_features is None else torch.cat([shared, roi_features], dim=1)
        return self.confidence(joined)[:, 0], self.residuals(joined)


class RefineInputs(NamedTuple):
    """Points, keypoints and proposals of B frames, concatenated; indices count through the batch."""

    points: Tensor
    """(N, 4) x, y, z in metres, LiDAR frame, and reflectance."""
    keypoints: Tensor
    """(K, 3)."""
    bev: Tensor
    """(K, C) the first stage's map at the keypoints, see `bilinear_cells`."""
    ball_indices: tuple[Tensor, ...]
    """(K, T) points around the keypoints per radius; N stands for none."""
    grid_points: Tensor
    """(R * cells, 3) of the proposals."""
    grid_indices: tuple[Tensor, ...]
    """(R * cells, T) keypoints around the grid points per radius; K stands for none."""
    roi_features: Tensor
    """(R, F) what else is known of each proposal."""


class Refinements(NamedTuple):
    """Output of the second stage for R proposals and K keypoints."""

    confidence: Tensor
    """(R,) logits."""
    residuals: Tensor
    """(R, 7), see `ops.two_stage.rois`."""
    keypoint_logits: Tensor
    """(K,) of a keypoint's being part of an object."""


def zero_of_weights(module: nn.Module) -> Tensor:
    """Return a scalar 0 that gives every weight a gradient of zero."""
    return 0 * torch.stack([weight.sum() for weight in module.parameters()]).sum()


class PillarRefiner(nn.Module):
    """Second stage on pillars: keypoint encoding, RoI-grid pooling, confidence and residuals."""

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
