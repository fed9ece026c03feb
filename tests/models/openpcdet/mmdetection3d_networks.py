"""OpenPCDet's networks, which mmdetection3d 1.x has with the same equations, under its names and in its shapes."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from tests.models.openpcdet import foreign_networks


def write_mmdetection3d(path: Path, state: dict[str, Tensor], **meta: Any) -> Path:
    """A file as its training writes it; `meta` joins what stands beside the weights."""
    content = {"epoch": 80, "iter": 37120, "dataset_meta": {"classes": ("Pedestrian", "Cyclist", "Car")}} | meta
    torch.save({"meta": content, "state_dict": state, "optimizer": {"state": {}}}, path)
    return path


NAMES = {
    r"^vfe\.": "voxel_encoder.",
    r"^backbone_3d\.conv(\d)\.": r"middle_encoder.encoder_layers.encoder_layer\1.",
    r"^backbone_3d\.": "middle_encoder.",
    r"^backbone_2d\.blocks\.": "backbone.blocks.",
    r"^backbone_2d\.": "neck.",
    r"^dense_head\.conv_box": "dense_head.conv_reg",
    r"^pfe\.SA_rawpoints\.": "points_encoder.rawpoints_sa_layer.",
    r"^pfe\.SA_layers\.": "points_encoder.voxel_sa_layers.",
    r"^pfe\.vsa_point_feature_fusion\.": "points_encoder.point_feature_fusion_layer.",
    r"^point_head\.cls_layers\.": "roi_head.semantic_head.seg_cls_layer.",
    r"^roi_head\.roi_grid_pool_layer\.": "roi_head.bbox_roi_extractor.roi_grid_pool_layer.",
    r"^roi_head\.shared_fc_layer\.": "roi_head.bbox_head.shared_fc_layer.",
    r"^roi_head\.(cls|reg)_layers\.": r"roi_head.bbox_head.\1_layer.",
}
# Of layers that are modules of mmcv, the places of convolution and normalization in OpenPCDet's sequence.
BALL = {
    str(3 * number + place): f"layer{number}.{part}" for number in range(3) for place, part in enumerate(("conv", "bn"))
}
CONNECTED = {"0": "0.conv", "1": "0.bn", "4": "2.conv", "5": "2.bn", "7": "3"}
MODULES = (
    (r"(sa_layers?\.(?:\d\.)?mlps\.\d|grid_pool_layer\.mlps\.\d)\.(\d)\.", BALL),
    (r"(point_feature_fusion_layer|bbox_head\.\w+_layer)\.(\d)\.", CONNECTED),
)


def in_mmdetection3d(state: Mapping[str, Tensor], head: str) -> dict[str, Tensor]:
    """Weights of OpenPCDet's network as mmdetection3d stores them; `head` is its name for the head of anchors."""
    found = {}
    for name, value in state.items():
        for there, here in NAMES.items():
            name = re.sub(there, here, name)
        name = re.sub(r"^dense_head", head, name)
        # A block begins with a padding of its own there, and with none here.
        name = re.sub(r"^(backbone\.blocks\.\d)\.(\d+)", lambda m: f"{m[1]}.{int(m[2]) - 1}", name)
        for layers, places in MODULES:
            if layer := re.search(layers, name):
                name = name.replace(layer[0], f"{layer[1]}.{places[layer[2]]}.")
        if value.ndim > 1 and re.search(r"roi_head\.bbox_head|fusion_layer", name):  # 1x1 convolutions on maps
            value = value.reshape(*value.shape[:2], 1, 1)
        found[name] = value
    return found


class PointPillars(foreign_networks.PointPillars):
    """PillarFeatureNet, SECOND, SECONDFPN and Anchor3DHead."""

    def state_dict(self, *_: Any, **__: Any) -> Any:
        return in_mmdetection3d(super().state_dict(), "bbox_head")


class PvRcnn(foreign_networks.PvRcnn):
    """SparseEncoder, SECOND, SECONDFPN, PartA2RPNHead, VoxelSetAbstraction and PVRCNNRoiHead."""

    def state_dict(self, *_: Any, **__: Any) -> Any:
        return in_mmdetection3d(super().state_dict(), "rpn_head")
