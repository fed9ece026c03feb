"""PV-RCNN (arXiv 1912.13192): voxels propose, keypoints refine."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from asca_pillars.config.pv_rcnn import Attention, PvRcnnModel
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.models.map_layers import as_map, convolution_block, joined_maps, upsampling
from asca_pillars.models.pillar.head import SSDHead
from asca_pillars.models.pv_rcnn.adaptive_scales import AdaptiveScales
from asca_pillars.models.pv_rcnn.batch import VoxelBatch, deformed_balls
from asca_pillars.models.pv_rcnn.deformation import AuthorsDeformation, PaperDeformation, Surroundings
from asca_pillars.models.pv_rcnn.dual_attention import DualAttention
from asca_pillars.models.pv_rcnn.voxel_backbone import VoxelBackbone
from asca_pillars.models.two_stage.keypoint_encoder import BallSource, KeypointEncoder, SourceRows
from asca_pillars.models.two_stage.roi_head import RoiHead
from asca_pillars.models.two_stage.set_abstraction import SetAbstraction
from asca_pillars.models.two_stage.vector_pool import VectorPool
from asca_pillars.ops.pv_rcnn.prepare import LEVEL_SOURCES, Source, VoxelSetSettings
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec

POINT_CHANNELS = 4  # x, y, z, reflectance
_BLOCK_STRIDES = (1, 2)


class MapBackbone(nn.Module):
    """The backbone on the map seen from above (section 3.1): two blocks, the second at half the resolution.

    With `attention` dual attention after each block, before its upsampling (AFE-RCNN, figure 3).
    """

    def __init__(
        self,
        in_channels: int,
        block_channels: Sequence[int],
        block_convs: Sequence[int],
        upsample_channels: int,
        attention: Attention = "none",
    ) -> None:
        super().__init__()
        self.blocks, self.deblocks, stride = nn.ModuleList(), nn.ModuleList(), 1
        self.attention: nn.ModuleList | None = None
        if attention != "none":
            self.attention = nn.ModuleList(
                DualAttention(channels, residual=attention == "rda") for channels in block_channels
            )
        for channels, convs, step in zip(block_channels, block_convs, _BLOCK_STRIDES, strict=True):
            stride *= step
            self.blocks.append(convolution_block(in_channels, channels, convs, stride=step))
            self.deblocks.append(upsampling(channels, upsample_channels, stride))
            in_channels = channels
        self.out_channels = upsample_channels * len(self.blocks)

    def forward(self, canvas: Tensor) -> Tensor:
        """Unitless (B, C, H, W) -> (B, out_channels, H, W)."""
        return joined_maps(canvas, self.blocks, self.deblocks, self.attention)


class FirstStageOutputs(NamedTuple):
    """What the voxels say."""

    levels: list[Tensor]
    """Features (M, channels) of the active voxels of every level."""
    canvas: Tensor
    """(B, H, W, C) conv_out seen from above, what the map's backbone reads."""
    maps: HeadMaps[Tensor]
    """Scores (B, A * classes, H, W), boxes (B, 7A, H, W), directions (B, 2A, H, W)."""


class PvRcnn(nn.Module):
    """The network.

    Args:
        spec: grid, strides and classes that its parts were made for.
        settings: its sources, likewise.
        voxels: the sparse 3D backbone.
        neck: the backbone on the map seen from above.
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
        """Voxels (N, 4), metres and reflectance -> unitless features (M, C) of every level, and head maps."""
        levels = self.voxels(batch.features, batch.levels)
        canvas = self.scatter(levels[-1], batch.levels[-1].cells, len(batch.frame_keypoints))
        maps: HeadMaps[Tensor] = self.head(self.neck(as_map(canvas)))
        return FirstStageOutputs(levels, canvas, maps)

    def scatter(self, features: Tensor, cells: Tensor, frames: int) -> Tensor:
        """conv_out's voxels, one above the other, as channels of a map: (M, C) -> (B, H, W, nz * C), z-major.

        Args:
            features: of the active cells of conv_out.
            cells: (M,) their flat indices, z running fastest, counted through the frames.
            frames: B.
        """
        nz, rows, columns = self.spec.level_shapes[-1]
        empty = features.new_zeros(frames * rows * columns * nz, features.shape[1])
        return empty.index_put((cells,), features).view(frames, rows, columns, -1)

    def describe(self, batch: VoxelBatch[Tensor], levels: Sequence[Tensor], canvas: Tensor) -> tuple[Tensor, Tensor]:
        """Weighted features (K, C) of the keypoints, and logits (K,) of their being part of an object."""
        cells = canvas.flatten(0, 2)
        bev = sum(
            cells.index_select(0, batch.bev_cells[:, corner]) * batch.bev_weights[:, corner, None]
            for corner in range(batch.bev_cells.shape[1])
        )
        assert isinstance(bev, Tensor)
        beside = bev if self.scales is None else torch.cat([self.scales(batch.points, batch.scales), bev], dim=1)
        rows = [
            SourceRows(where, _source_features(each.source, batch.points, levels))
            for each, where in zip(self.settings.sources, batch.positions, strict=True)
        ]
        if not self.settings.deformed:
            features, logits = self.encode(rows, batch.keypoints, beside, batch.ball_indices)
            return features, logits
        places = self.deformed_places(batch, levels)
        if self.settings.deform == "authors_frozen":
            places = {name: [place.detach() for place in each] for name, each in places.items()}
            rows = [
                SourceRows(own.positions, own.features.detach()) if each.source in places else own
                for each, own in zip(self.settings.sources, rows, strict=True)
            ]
        indices, centers = deformed_balls(batch, self.settings, places)
        features, logits = self.encode(rows, batch.keypoints, beside, indices, centers)
        return features, logits

    def deformed_places(self, batch: VoxelBatch[Tensor], levels: Sequence[Tensor]) -> dict[str, list[Tensor]]:
        """Around which places (K, 3), metres, keypoints look at each deformed source: one, or one for each radius."""
        places, first = {}, 0
        for number, each in enumerate(self.settings.sources):
            balls = batch.ball_indices[first : first + len(each.radii_m)]
            first += len(balls)
            if each in self.settings.deformed:
                around = Surroundings(
                    _source_features(each.source, batch.points, levels),
                    batch.positions[number],
                    batch.keypoints,
                    balls,
                    batch.nearest[number],
                    batch.nearest_weights[number],
                )
                places[str(each.source)] = self.deform[each.source](around)
        return places


def _source_features(source: Source, points: Tensor, levels: Sequence[Tensor]) -> Tensor:
    return points[:, 3:] if source == "points" else levels[LEVEL_SOURCES.index(source)]


def build_pv_rcnn(model: PvRcnnModel) -> PvRcnn:
    """The network that `model` describes, with fresh random weights."""
    network, spec, settings = model.network, model.spec, model.settings
    channels = {"points": POINT_CHANNELS - 3, **dict(zip(LEVEL_SOURCES, network.voxel_channels[:-1], strict=True))}
    map_channels = network.voxel_channels[-1] * spec.level_shapes[-1][0]
    neck = MapBackbone(
        map_channels, network.block_channels, network.block_convs, network.upsample_channels, network.attention
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
                    channels[each.source],
                    len(each.radii_m),
                    widths,
                    gated=each.source == "points" and network.gate == "keypoint",
                )
                for each, widths in zip(settings.sources, network.source_widths, strict=True)
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
            each.source: PaperDeformation(channels[each.source])
            if settings.deform == "paper"
            else AuthorsDeformation(channels[each.source])
            for each in settings.deformed
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
