"""Networks with the names, shapes and equations that mmdetection3d 1.x publishes, in plain dense PyTorch."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from tests.models.openpcdet.foreign_networks import (
    AnchorHead,
    PillarLayer,
    SparseLayer,
    foreground,
    map_features,
    map_layers,
)


def write_mmdetection3d(path: Path, state: dict[str, Tensor], **meta: Any) -> Path:
    """A file as its training writes it; `meta` joins what stands beside the weights."""
    content = {"epoch": 80, "iter": 37120, "dataset_meta": {"classes": ("Pedestrian", "Cyclist", "Car")}} | meta
    torch.save({"meta": content, "state_dict": state, "optimizer": {"state": {}}}, path)
    return path


class ConvModule(nn.Module):
    """mmcv's: a 1x1 convolution on (B, C, H, W), its normalization and a ReLU."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, width, 1, bias=False)
        self.bn = nn.BatchNorm2d(width)

    def forward(self, features: Tensor) -> Tensor:
        return torch.relu(self.bn(self.conv(features)))


class MapDetector(nn.Module):
    """SECOND and SECONDFPN, blocks and upsamplings of one neck in modules of their own."""

    backbone: Any
    neck: Any

    def __init__(
        self, channels: int, widths: Sequence[int], convs: Sequence[int], strides: Sequence[int], up: int
    ) -> None:
        super().__init__()
        self.backbone, self.neck = nn.Module(), nn.Module()
        self.backbone.blocks, self.neck.deblocks = map_layers(channels, widths, convs, strides, up, pad_first=False)

    def above(self, canvas: Tensor) -> Tensor:
        return map_features(self.backbone.blocks, self.neck.deblocks, canvas)


class Anchor3DHead(AnchorHead):
    """Its three 1x1 convolutions."""

    BOXES = "conv_reg"


class PointPillars(MapDetector):
    """PillarFeatureNet, SECOND, SECONDFPN and Anchor3DHead."""

    voxel_encoder: Any

    def __init__(self, channels: int, widths: Sequence[int], convs: Sequence[int], up: int, classes: int) -> None:
        super().__init__(channels, widths, convs, (2, 2, 2), up)
        self.voxel_encoder = nn.Module()
        self.voxel_encoder.pfn_layers = nn.ModuleList([PillarLayer(channels)])
        self.bbox_head = Anchor3DHead(3 * up, 2 * classes, classes)


def set_abstraction(channels: int, radii: int, widths: Sequence[int]) -> nn.Module:
    """StackedSAModuleMSG: an MLP for each radius, whose layers have names."""
    module = nn.Module()
    module.mlps = nn.ModuleList()
    for _ in range(radii):
        mlp, read = nn.Sequential(), 3 + channels
        for number, width in enumerate(widths):
            mlp.add_module(f"layer{number}", ConvModule(read, width))
            read = width
        module.mlps.append(mlp)
    return module


def fully_connected(channels: int, hidden: int, out: int | None) -> nn.Sequential:
    """Of PVRCNNBBoxHead, on (R, C, 1, 1)."""
    layers: list[nn.Module] = [ConvModule(channels, hidden), nn.Dropout(0.3), ConvModule(hidden, hidden)]
    return nn.Sequential(*layers, *([] if out is None else [nn.Conv2d(hidden, out, 1)]))


class PvRcnn(MapDetector):
    """SparseEncoder, SECOND, SECONDFPN, PartA2RPNHead, VoxelSetAbstraction and PVRCNNRoiHead.

    Args:
        widths: of the four stages of the encoder and of its output.
        neck: output channels of blocks, convolutions after each one's first, output channels after upsampling.
        classes: how many.
        balls: of raw points (first) and of the stages that are read: channels of the source, radii, MLP.
        keypoint: channels of a fused feature.
        weighting: hidden channels of the foreground segmentation.
        grid: grid points along an axis, radii, MLP, hidden channels.
    """

    middle_encoder: Any
    points_encoder: Any
    roi_head: Any

    def __init__(
        self,
        widths: Sequence[int],
        neck: tuple[Sequence[int], Sequence[int], int],
        classes: int,
        balls: Sequence[tuple[int, int, Sequence[int]]],
        keypoint: int,
        weighting: int,
        grid: tuple[int, int, Sequence[int], int],
    ) -> None:
        super().__init__(2 * widths[4], neck[0], neck[1], (1, 2), neck[2])
        self.middle_encoder = nn.Module()
        self.middle_encoder.conv_input = SparseLayer(4, widths[0], (3, 3, 3))
        self.middle_encoder.encoder_layers = nn.Module()
        for stage in range(4):
            reads = (widths[0],) if stage == 0 else (widths[stage - 1], widths[stage], widths[stage])
            layers = nn.Sequential(*(SparseLayer(read, widths[stage], (3, 3, 3)) for read in reads))
            setattr(self.middle_encoder.encoder_layers, f"encoder_layer{stage + 1}", layers)
        self.middle_encoder.conv_out = SparseLayer(widths[3], widths[4], (3, 1, 1))
        self.rpn_head = Anchor3DHead(2 * neck[2], 2 * classes, classes)
        self.points_encoder = nn.Module()
        self.points_encoder.rawpoints_sa_layer, *others = (set_abstraction(*each) for each in balls)
        self.points_encoder.voxel_sa_layers = nn.ModuleList(others)
        joined = 2 * widths[4] + sum(radii * mlp[-1] for _, radii, mlp in balls)
        self.points_encoder.point_feature_fusion_layer = nn.Sequential(ConvModule(joined, keypoint))
        self.roi_head = nn.Module()
        self.roi_head.semantic_head = nn.Module()
        self.roi_head.semantic_head.seg_cls_layer = foreground(joined, weighting)
        size, radii, mlp, hidden = grid
        self.roi_head.bbox_roi_extractor = nn.Module()
        self.roi_head.bbox_roi_extractor.roi_grid_pool_layer = set_abstraction(keypoint, radii, mlp)
        self.roi_head.bbox_head = nn.Module()
        self.roi_head.bbox_head.shared_fc_layer = fully_connected(size**3 * radii * mlp[-1], hidden, None)
        self.roi_head.bbox_head.cls_layer = fully_connected(hidden, hidden, 1)
        self.roi_head.bbox_head.reg_layer = fully_connected(hidden, hidden, 7)
