"""The second stage: keypoints and their features, RoI-grid pooling, confidence and residuals (PV-RCNN, 3.2 to 3.4).

Features of points are aggregated by set abstraction (PointNet++) or VectorPool (PV-RCNN++, arXiv 2102.00463).
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.ops.points.neighbors import cube_cells_m

NORM_EPS, NORM_MOMENTUM = 1e-5, 0.1  # PV-RCNN's of point features: torch's own


def mlp(in_channels: int, widths: Sequence[int], dropout: float = 0.0) -> list[nn.Module]:
    """Build Linear, BatchNorm, ReLU for each width; dropout between them."""
    layers: list[nn.Module] = []
    for width in widths:
        if layers and dropout:
            layers.append(nn.Dropout(dropout))
        layers += [
            nn.Linear(in_channels, width, bias=False),
            nn.BatchNorm1d(width, eps=NORM_EPS, momentum=NORM_MOMENTUM),
            nn.ReLU(),
        ]
        in_channels = width
    return layers


class SetAbstraction(nn.Module):
    """MLP(3 + C -> widths) on [p_j - q ; f_j] for the points j of the ball around q, then the maximum.

    The first layer is linear, so W [p_j - q ; f_j] = W [p_j ; f_j] - W [q ; 0]: once for each point and once for each
    query instead of once for each pair, exact up to rounding. It must stay in float32, because p_j and q are large and
    their difference is small.

    Args:
        in_channels: C, features of a point; may be 0.
        widths: output channels of the layers, each with BatchNorm and ReLU.
    """

    def __init__(self, in_channels: int, widths: Sequence[int]) -> None:
        super().__init__()
        inputs = [3 + in_channels, *widths[:-1]]
        self.layers = nn.ModuleList(nn.Linear(a, b, bias=False) for a, b in zip(inputs, widths, strict=True))
        self.norms = nn.ModuleList(nn.BatchNorm1d(width, eps=NORM_EPS, momentum=NORM_MOMENTUM) for width in widths)
        self.out_channels = widths[-1]

    def forward(self, positions: Tensor, features: Tensor, queries: Tensor, indices: Tensor) -> Tensor:
        """Return features of the queries, (Q, out_channels), see `grouped`."""
        return self.grouped(positions, features, queries, indices).max(dim=1).values

    def grouped(self, positions: Tensor, features: Tensor, queries: Tensor, indices: Tensor) -> Tensor:
        """Return the output of the MLP for each point of each ball, (Q, T, out_channels).

        Args:
            positions: (N, 3) of the points, metres, in the frame of the queries.
            features: (N, C).
            queries: (Q, 3).
            indices: (Q, T) points of each ball, see `ball_query`; N stands for nothing. An empty ball is a row of
                zeros, so its features are MLP(0).
        """
        first: Tensor = self.layers[0].weight  # type: ignore[assignment]  # (widths[0], 3 + C)
        points = F.linear(torch.cat([positions, features], dim=1), first)  # (N, widths[0])
        points = F.pad(points, (0, 0, 0, 1))  # row N
        is_neighbor = (indices[:, :1] < positions.shape[0]).to(points.dtype)
        centers = F.linear(queries, first[:, :3]) * is_neighbor  # (Q, widths[0])
        grouped = points.index_select(0, indices.reshape(-1)).unflatten(0, indices.shape) - centers[:, None]
        return self.after_first(grouped.flatten(0, 1)).unflatten(0, indices.shape)

    def after_first(self, pairs: Tensor) -> Tensor:
        """Apply the layers after the first: (Q * T, channels) -> (Q * T, channels)."""
        pairs = torch.relu(self.norms[0](pairs))
        for layer, norm in zip(self.layers[1:], self.norms[1:], strict=True):
            pairs = torch.relu(norm(layer(pairs)))
        return pairs


def first_occurrences(indices: Tensor, count: int) -> Tensor:
    """Return (Q, T) 1 for points that `ball_query` found, 0 for repetitions of the first one and for index `count`."""
    again = (indices[:, 1:] != indices[:, :1]) & (indices[:, 1:] < count)
    return torch.cat([indices[:, :1] < count, again], dim=1).float()


_NEAREST = 3
_LEAST_DISTANCE_M = 1e-8  # lower bound, for a point at a cell's center


class VectorPool(nn.Module):
    """MLP(U_1 ; ... ; U_T) with U_t = ReLU(BatchNorm([a_i - v_t ; h_t] W_t)) for the T cells of a cube (eq. 13 to 15).

    h_t W_t is the mean, by inverse distance, of what h_i W_t is for the three points i: W_t is applied once to each
    point instead of once to each query.

    Args:
        in_channels: of a point.
        half_length_m: half the length of the cube.
        cells: of the cube along each axis, so that T = cells^3.
        cell_channels: outputs of each W_t.
        widths: of the MLP.
    """

    centers: Tensor

    def __init__(
        self, in_channels: int, half_length_m: float, cells: int, cell_channels: int, widths: Sequence[int]
    ) -> None:
        super().__init__()
        self.register_buffer("centers", torch.from_numpy(cube_cells_m(half_length_m, cells)), persistent=False)
        count = cells**3
        self.places = nn.Parameter(torch.empty(count, 3 * _NEAREST, cell_channels))
        self.features = nn.Linear(in_channels, count * cell_channels, bias=False)
        for weight in (self.places, self.features.weight):  # both are parts of W_t
            nn.init.uniform_(weight, -((3 * _NEAREST + in_channels) ** -0.5), (3 * _NEAREST + in_channels) ** -0.5)
        self.norm = nn.BatchNorm1d(count * cell_channels, eps=NORM_EPS, momentum=NORM_MOMENTUM)
        self.mlp = nn.Sequential(*mlp(count * cell_channels, widths))
        self.out_channels = widths[-1]

    def forward(self, positions: Tensor, features: Tensor, queries: Tensor, indices: Tensor) -> Tensor:
        """Return features of the queries, (Q, out_channels).

        Args:
            positions: (N, 3) of the points, metres, in the frame of the queries.
            features: (N, in_channels).
            queries: (Q, 3).
            indices: (Q, T, 3) points nearest to each cell, see `nearest_in_cubes`; N stands for nothing: zeros.
        """
        # h_i W_t of every point, cell by cell, and zeros for N
        of_points = F.pad(self.features(features), (0, 0, 0, 1)).unflatten(1, (len(self.centers), -1)).transpose(0, 1)
        padded = F.pad(positions, (0, 0, 0, 1))
        cells = [
            self._cell(self.places[cell], of_points[cell], padded, queries + self.centers[cell], indices[:, cell])
            for cell in range(len(self.centers))  # all at once they take more time and memory
        ]
        pooled: Tensor = self.mlp(torch.relu(self.norm(torch.cat(cells, dim=1))))
        return pooled

    @staticmethod
    def _cell(place: Tensor, of_points: Tensor, padded: Tensor, centers: Tensor, index: Tensor) -> Tensor:
        """Return [a_i - v_t ; h_t] W_t of one cell, (Q, cell_channels)."""
        is_neighbor = (index < padded.shape[0] - 1).to(padded.dtype)  # (Q, 3)
        near = padded.index_select(0, index.reshape(-1)).unflatten(0, index.shape)
        away = (near - centers[:, None]) * is_neighbor[..., None]  # a_i - v_t
        # Not `+`: onnxscript takes so small an addition for none.
        shares = is_neighbor / away.square().sum(dim=2).sqrt().clamp(min=_LEAST_DISTANCE_M)
        shares = shares / shares.sum(dim=1, keepdim=True).clamp(min=_LEAST_DISTANCE_M)
        rows = of_points.index_select(0, index.reshape(-1)).unflatten(0, index.shape)  # (Q, 3, cell_channels)
        return away.flatten(1) @ place + (rows * shares[..., None]).sum(dim=1)


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
        """Apply the gate: (K, C) -> (K, C)."""
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
        by_source, balls = [], iter(zip(self.balls, indices, centers or [keypoints] * len(indices), strict=True))
        for number, (source_rows, source) in enumerate(zip(rows, self.sources, strict=True)):
            of_radii = [
                ball(source_rows.positions, source_rows.features, center, index)
                for ball, index, center in itertools.islice(balls, source.radii)
            ]
            features = torch.cat(of_radii, dim=1)
            by_source.append(self.gates[str(number)](features) if source.gated else features)
        joined = torch.cat([*by_source, bev], dim=1)
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
    """(R, 7), see `ops.two_stage.decode`."""
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
