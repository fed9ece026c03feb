"""Layers and network of PV-RCNN (arXiv 1912.13192), and the extensions of its keypoint features.

These are adaptive scales (AFE-RCNN, 3.2) and adaptive deformation.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.models.map_backbone import (
    NORM_EPS,
    NORM_MOMENTUM,
    MapBackbone,
    SSDHead,
    as_map,
    rulebook_conv,
)
from asca_pillars.models.pv_rcnn.preparation import VoxelBatch, deformed_balls
from asca_pillars.models.two_stage.layers import (
    BallSource,
    KeypointEncoder,
    RoiHead,
    SetAbstraction,
    SourceRows,
    VectorPool,
    first_occurrences,
    mlp,
)
from asca_pillars.ops.points.neighbors import PointScale
from asca_pillars.ops.pv_rcnn.prepare import LEVEL_SOURCES, Source, VoxelSetSettings
from asca_pillars.ops.pv_rcnn.rulebooks import SUBMANIFOLD, VoxelLevel
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec
from asca_pillars.ops.sparse.rulebooks import Convolution

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
        """Adjust features of groups (M, T, C) -> the same shape.

        Args:
            features: F.
            counted: (M, T) 1 for the members of each group, 0 for what only fills it.
        """
        adjusted = features * (1 + self.out(torch.relu(self.hidden(features))))
        difference = features[:, :, None] - features[:, None]  # (M, T, T, C): F_i - F_j, zero where i is j
        # The hidden layer is linear before its ReLU: W (F_i - F_j) + b = W F_i - W F_j + b.
        within = F.linear(features, self.hidden.weight)
        impact = self.out(torch.relu(within[:, :, None] - within[:, None] + self.hidden.bias))
        return adjusted + (impact * difference * counted[:, None, :, None]).sum(dim=2)


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
        positions, features, by_scale = points[:, :3], points[:, 3:], []
        for lift, adjust, scale in zip(self.lift, self.adjust, scales, strict=True):
            assert isinstance(lift, SetAbstraction)
            grouped = lift.grouped(positions, features, scale.positions, scale.groups)  # (M, T, C)
            features = adjust(grouped, first_occurrences(scale.groups, positions.shape[0])).max(dim=1).values
            positions = scale.positions
            by_scale.append(features)
        joined = by_scale[-1]
        for finer, scale in zip(by_scale[-2::-1], scales[:0:-1], strict=True):
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
        offset = (_gathered(offsets, around.nearest) * around.nearest_weights[:, :, None]).sum(dim=1)  # (K, 16)
        relative, _ = _relative(around, index)  # v_j - v_i
        is_first = first_occurrences(index, around.positions.shape[0]).to(offset)  # the sum has every neighbor once
        difference = (offset[:, None] - _gathered(offsets, index)) * is_first[:, :, None]
        mean = difference.transpose(1, 2) @ -relative / is_first.sum(dim=1).clamp(min=1)[:, None, None]  # (K, 16, 3)
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
            relative, is_neighbor = _relative(around, index)
            features = _gathered(F.pad(around.features, (0, 0, 0, 1)), index)
            share = torch.tanh(self.offset(torch.cat([relative, features], dim=2)))
            mean = (share * relative).sum(dim=1) / is_neighbor.sum(dim=1).clamp(min=1)[:, None]
            shifted.append(around.keypoints + mean)
        return shifted


def _gathered(rows: Tensor, index: Tensor) -> Tensor:
    """Gather (N, C) by (K, T) -> (K, T, C)."""
    return rows.index_select(0, index.reshape(-1)).unflatten(0, index.shape)


def _relative(around: Surroundings, index: Tensor) -> tuple[Tensor, Tensor]:
    """Return v_j - v_i (K, T, 3), zeros for empty entries, and a mask of the others (K, T)."""
    is_neighbor = (index < around.positions.shape[0]).to(around.positions.dtype)
    positions = _gathered(F.pad(around.positions, (0, 0, 0, 1)), index)
    return (positions - around.keypoints[:, None]) * is_neighbor[:, :, None], is_neighbor


_RESIDUAL_WEIGHT = 0.1  # epsilon of eq. (5)


class DualAttention(nn.Module):
    """Eq. (1)-(5) with the widths of polarized self-attention (arXiv 2107.00782).

    Args:
        channels: C of the map.
        residual: X + 0.1 O_s (eq. 5); without it O_s alone, the paper's Table 5 compares the two.
    """

    def __init__(self, channels: int, *, residual: bool) -> None:
        super().__init__()
        half = max(channels // 2, 1)
        self.residual = residual
        self.channel_value = nn.Conv2d(channels, half, 1)
        self.channel_query = nn.Conv2d(channels, 1, 1, bias=False)  # the softmax over places would not see a bias
        self.channel_out = nn.Linear(half, channels)
        self.channel_norm = nn.LayerNorm(channels)
        self.place_value = nn.Conv2d(channels, half, 1)
        self.place_query = nn.Conv2d(channels, half, 1)

    def forward(self, features: Tensor) -> Tensor:
        """Apply the attention: (B, C, H, W) -> the same shape."""
        attended = self.by_location(self.by_channel(features))
        return features + _RESIDUAL_WEIGHT * attended if self.residual else attended

    def by_channel(self, features: Tensor) -> Tensor:
        """Return eq. (1) and (2): a weight in (0, 1) for each channel of (B, C, H, W)."""
        values = self.channel_value(features).flatten(2)  # (B, C / 2, HW)
        shares = torch.softmax(self.channel_query(features).flatten(2), dim=2)  # (B, 1, HW)
        pooled = (values @ shares.transpose(1, 2))[:, :, 0]
        weights = torch.sigmoid(self.channel_norm(self.channel_out(pooled)))
        return features * weights[:, :, None, None]

    def by_location(self, features: Tensor) -> Tensor:
        """Return eq. (3) and (4): a weight in (0, 1) for each place of (B, C, H, W)."""
        values = self.place_value(features)  # (B, C / 2, H, W)
        shares = torch.softmax(self.place_query(features).mean(dim=(2, 3)), dim=1)  # (B, C / 2)
        return features * torch.sigmoid((values * shares[:, :, None, None]).sum(dim=1, keepdim=True))


_CONVS = 2  # submanifold convolutions of each level but the last


class SparseConvBlock(nn.Module):
    """Sparse convolution, BatchNorm over active cells, ReLU; its weight has the shape of a dense convolution's."""

    def __init__(self, in_channels: int, channels: int, convolution: Convolution) -> None:
        super().__init__()
        self.convolution = nn.Conv3d(in_channels, channels, convolution.kernel, bias=False)
        self.norm = nn.BatchNorm1d(channels, eps=NORM_EPS, momentum=NORM_MOMENTUM)

    def forward(self, features: Tensor, rulebook: Tensor, back: Tensor | None = None) -> Tensor:
        """Apply the block: (N, in_channels) -> (M, channels), see `rulebook_conv`."""
        return torch.relu(self.norm(rulebook_conv(features, self.convolution.weight, rulebook, back)))


class VoxelBackbone(nn.Module):
    """Sparse 3D backbone, conv1 to conv4 and conv_out; each level halves the lattice before it.

    Args:
        in_channels: of a voxel.
        channels: output channels of the levels.
        strided: the convolutions that lead from level to level.
    """

    def __init__(self, in_channels: int, channels: Sequence[int], strided: Sequence[Convolution]) -> None:
        super().__init__()
        *inner, out = channels
        self.down = nn.ModuleList(
            SparseConvBlock(before, after, convolution)
            for before, after, convolution in zip(channels[:-1], channels[1:], strided, strict=True)
        )
        reads = [in_channels, *inner[1:]]
        self.same = nn.ModuleList(
            nn.ModuleList(
                SparseConvBlock(read if number == 0 else width, width, SUBMANIFOLD) for number in range(_CONVS)
            )
            for read, width in zip(reads, inner, strict=True)
        )
        self.out_channels = out

    def forward(self, features: Tensor, levels: Sequence[VoxelLevel[Tensor]]) -> list[Tensor]:
        """Encode voxel features (N, in_channels) -> (M, channels) of the active cells of every level."""
        by_level = []
        for number, level in enumerate(levels):
            if number:
                features = self.down[number - 1](features, level.strided, level.strided_back)
            if number < len(self.same):
                for layer in self.same[number].children():
                    features = layer(features, level.same)
            by_level.append(features)
        return by_level


POINT_CHANNELS = 4  # x, y, z, reflectance
_BLOCK_STRIDES = (1, 2)


class FirstStageOutputs(NamedTuple):
    """Outputs of the first stage."""

    levels: list[Tensor]
    """Features (M, channels) of the active voxels of every level."""
    canvas: Tensor
    """(B, H, W, C) conv_out as a bird's-eye-view map, the input of the 2D backbone."""
    maps: HeadMaps[Tensor]
    """Scores (B, A * classes, H, W), boxes (B, 7A, H, W), directions (B, 2A, H, W)."""


class PvRcnn(nn.Module):
    """Network of PV-RCNN.

    Args:
        spec: grid, strides and classes that its parts were made for.
        settings: its sources, likewise.
        voxels: the sparse 3D backbone.
        neck: the 2D backbone on the bird's-eye-view map.
        head: of the anchors, each with a score for every class.
        encode: voxel set abstraction and keypoint weighting (sections 3.2 and 3.3).
        refine: RoI-grid pooling and the second stage's heads (section 3.4).
        deform: what shifts the keypoints of each deformed source, by its name.
        scales: features of raw points at several scales, beside those of `settings.sources`.
    """

    def __init__(
        self,
        spec: VoxelSpec,
        settings: VoxelSetSettings,
        *,
        voxels: VoxelBackbone,
        neck: MapBackbone,
        head: SSDHead,
        encode: KeypointEncoder,
        refine: RoiHead,
        deform: Mapping[str, nn.Module],
        scales: AdaptiveScales | None = None,
    ) -> None:
        super().__init__()
        self.spec, self.settings = spec, settings
        self.voxels = voxels
        self.neck = neck
        self.head = head
        self.encode = encode
        self.refine = refine
        self.deform = nn.ModuleDict(deform).requires_grad_(settings.deform != "authors_frozen")
        self.scales = scales

    def propose(self, batch: VoxelBatch[Tensor]) -> FirstStageOutputs:
        """Encode voxels (N, 4), metres and reflectance -> features (M, C) of every level, and head maps."""
        levels = self.voxels(batch.features, batch.levels)
        canvas = self.scatter(levels[-1], batch.levels[-1].cells, len(batch.frame_keypoints))
        maps: HeadMaps[Tensor] = self.head(self.neck(as_map(canvas)))
        return FirstStageOutputs(levels, canvas, maps)

    def scatter(self, features: Tensor, cells: Tensor, frames: int) -> Tensor:
        """Scatter the voxels of conv_out to a map, z-major in its channels: (M, C) -> (B, H, W, nz * C).

        Args:
            features: of the active cells of conv_out.
            cells: (M,) their flat indices, z running fastest, counted through the frames.
            frames: B.
        """
        nz, rows, columns = self.spec.level_shapes[-1]
        empty = features.new_zeros(frames * rows * columns * nz, features.shape[1])
        return empty.index_put((cells,), features).view(frames, rows, columns, -1)

    def encode_keypoints(
        self, batch: VoxelBatch[Tensor], levels: Sequence[Tensor], canvas: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return weighted features (K, C) of the keypoints, and foreground logits (K,)."""
        cells = canvas.flatten(0, 2)
        bev = sum(
            cells.index_select(0, batch.bev_cells[:, corner]) * batch.bev_weights[:, corner, None]
            for corner in range(batch.bev_cells.shape[1])
        )
        assert isinstance(bev, Tensor)
        context = bev if self.scales is None else torch.cat([self.scales(batch.points, batch.scales), bev], dim=1)
        rows = [
            SourceRows(where, _source_features(sa.source, batch.points, levels))
            for sa, where in zip(self.settings.sources, batch.positions, strict=True)
        ]
        if not self.settings.deformed:
            features, logits = self.encode(rows, batch.keypoints, context, batch.ball_indices)
            return features, logits
        places = self.deformed_positions(batch, levels)
        if self.settings.deform == "authors_frozen":
            places = {name: [place.detach() for place in shifted] for name, shifted in places.items()}
            rows = [
                SourceRows(given.positions, given.features.detach()) if sa.source in places else given
                for sa, given in zip(self.settings.sources, rows, strict=True)
            ]
        indices, centers = deformed_balls(batch, self.settings, places)
        features, logits = self.encode(rows, batch.keypoints, context, indices, centers)
        return features, logits

    def deformed_positions(self, batch: VoxelBatch[Tensor], levels: Sequence[Tensor]) -> dict[str, list[Tensor]]:
        """Return shifted positions (K, 3), metres, of keypoints for each deformed source: one, or one per radius."""
        places, first = {}, 0
        for number, sa in enumerate(self.settings.sources):
            balls = batch.ball_indices[first : first + len(sa.radii_m)]
            first += len(balls)
            if sa in self.settings.deformed:
                around = Surroundings(
                    _source_features(sa.source, batch.points, levels),
                    batch.positions[number],
                    batch.keypoints,
                    balls,
                    batch.nearest[number],
                    batch.nearest_weights[number],
                )
                places[str(sa.source)] = self.deform[sa.source](around)
        return places


def _source_features(source: Source, points: Tensor, levels: Sequence[Tensor]) -> Tensor:
    return points[:, 3:] if source == "points" else levels[LEVEL_SOURCES.index(source)]


def build_pv_rcnn(model: PvRcnnModel) -> PvRcnn:
    """Build the network that `model` describes, with fresh random weights."""
    network, spec, settings = model.network, model.spec, model.settings
    channels = {"points": POINT_CHANNELS - 3, **dict(zip(LEVEL_SOURCES, network.voxel_channels[:-1], strict=True))}
    map_channels = network.voxel_channels[-1] * spec.level_shapes[-1][0]
    neck = MapBackbone(
        map_channels,
        network.block_channels,
        network.block_convs,
        network.upsample_channels,
        strides=_BLOCK_STRIDES,
        attention=None
        if network.attention == "none"
        else [DualAttention(channels, residual=network.attention == "rda") for channels in network.block_channels],
    )
    return PvRcnn(
        spec,
        settings,
        voxels=VoxelBackbone(POINT_CHANNELS, network.voxel_channels, spec.strided),
        neck=neck,
        head=SSDHead(neck.out_channels, spec.anchors.shape[2], scores_per_anchor=len(spec.classes)),
        encode=KeypointEncoder(
            [
                BallSource(
                    channels[sa.source],
                    len(sa.radii_m),
                    widths,
                    gated=sa.source == "points" and network.gate == "keypoint",
                )
                for sa, widths in zip(settings.sources, network.source_widths, strict=True)
            ],
            map_channels + (network.scale_channels if settings.scale_radii_m else 0),
            network.keypoint_channels,
            network.weighting_channels,
        ),
        refine=RoiHead(
            [_grid_pool(model, radius_m) for radius_m in settings.grid_radii_m],
            settings.grid_size,
            roi_channels=0,
            hidden=network.hidden,
            dropout=network.dropout,
        ),
        deform={
            sa.source: PaperDeformation(channels[sa.source])
            if settings.deform == "paper"
            else AuthorsDeformation(channels[sa.source])
            for sa in settings.deformed
        },
        scales=AdaptiveScales(channels["points"], network.scale_widths, network.scale_channels)
        if settings.scale_radii_m
        else None,
    )


def _grid_pool(model: PvRcnnModel, radius_m: float) -> SetAbstraction | VectorPool:
    network, cells = model.network, model.settings.vector_cells
    if not cells:
        return SetAbstraction(network.keypoint_channels, network.grid_widths)
    return VectorPool(network.keypoint_channels, radius_m, cells, network.vector_channels, network.grid_widths)
