"""mmdetection3d's PointPillars and PV-RCNN as ours: the networks of OpenPCDet under other names.

Their convolutions of a second stage and of set abstraction are modules with a `conv` and a `bn`, where OpenPCDet counts
layers; the layouts of the arrays are the same.
"""

import re
from collections.abc import Callable, Iterator, Mapping

from torch import Tensor

from asca_pillars.base.errors import TrainingError
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.models.openpcdet.key_mapping import KeyMapping, map_backbone_keys
from asca_pillars.models.openpcdet.pointpillars_keys import encoder_keys
from asca_pillars.models.openpcdet.pv_rcnn_keys import pv_rcnn_keys

_ENCODER, _VOXELS = "voxel_encoder.pfn_layers.0", "middle_encoder"
FIRST_LINEAR = f"{_ENCODER}.linear.weight"
FUSION = "points_encoder.point_feature_fusion_layer.0.conv.weight"
_OLD_FEATURES = 9  # features of a point before 1.0, whose boxes had other axes too


def _part(layer: str, layers: int) -> str:
    """Return `conv` or `bn` for OpenPCDet's layer number, where each module counts `layers` layers."""
    return ("conv", "bn")[int(layer) % layers]


_Name = Callable[[re.Match[str]], str]
_POOLS = {
    "pfe.SA_rawpoints": "points_encoder.rawpoints_sa_layer",
    "pfe.SA_layers": "points_encoder.voxel_sa_layers",
    "roi_head.roi_grid_pool_layer": "roi_head.bbox_roi_extractor.roi_grid_pool_layer",
}
_LAYERS = {"0": "0.conv", "1": "0.bn", "4": "2.conv", "5": "2.bn", "7": "3"}
"""Names of the fully connected layers: OpenPCDet has dropout at 3, mmdetection3d at 1."""
_NAMES: tuple[tuple[str, _Name], ...] = (
    (r"backbone_2d\.blocks\.(\d+)\.(\d+)", lambda m: f"backbone.blocks.{m[1]}.{int(m[2]) - 1}"),  # without the padding
    (r"backbone_2d\.deblocks", lambda _: "neck.deblocks"),
    (r"backbone_3d\.conv(\d)", lambda m: f"{_VOXELS}.encoder_layers.encoder_layer{m[1]}"),
    (r"backbone_3d", lambda _: _VOXELS),
    (
        r"(pfe\.SA_rawpoints|pfe\.SA_layers|roi_head\.roi_grid_pool_layer)(\.\d+)?\.mlps\.(\d+)\.(\d+)",
        lambda m: f"{_POOLS[m[1]]}{m[2] or ''}.mlps.{m[3]}.layer{int(m[4]) // 3}.{_part(m[4], 3)}",
    ),
    (
        r"pfe\.vsa_point_feature_fusion\.(\d)",
        lambda m: f"points_encoder.point_feature_fusion_layer.0.{_part(m[1], 2)}",
    ),
    (r"point_head\.cls_layers", lambda _: "roi_head.semantic_head.seg_cls_layer"),
    (r"roi_head\.(shared_fc|cls|reg)_layers?\.(\d)", lambda m: f"roi_head.bbox_head.{m[1]}_layer.{_LAYERS[m[2]]}"),
    (r"dense_head\.conv_box", lambda _: "dense_head.conv_reg"),
)
"""Prefixes of OpenPCDet's names, and their replacements."""


def mmdetection3d_keys(
    model: PillarModel | PvRcnnModel,
    state: Mapping[str, Tensor],
    our_state: Mapping[str, Tensor],
    *,
    legacy: bool = True,
) -> Iterator[KeyMapping]:
    """Yield the key mappings for our network of this model.

    Args:
        model: ours.
        state: their unitless weights (out, in, ...) by name.
        our_state: ours, likewise.
        legacy: their encoder's flag of that name, see `encoder_keys`; true unless a configuration says otherwise.

    Raises:
        TrainingError: points with other features.
    """
    if isinstance(model, PillarModel):
        _refuse_old_axes(state)
        yield from encoder_keys(model, state, _ENCODER, legacy=legacy)
        yield from (_renamed(mapping, "bbox_head") for mapping in map_backbone_keys(model.network.block_convs))
        return
    levels, voxels = (f"{_VOXELS}.encoder_layers.encoder_layer", "backbone_3d.conv"), (_VOXELS, "backbone_3d")
    renamed = {name.replace(*levels).replace(*voxels): array for name, array in state.items()}
    yield from (_renamed(mapping, "rpn_head") for mapping in pv_rcnn_keys(model, renamed, our_state))


def mmdetection3d_name(name: str, head: str = "rpn_head") -> str:
    """Return mmdetection3d's name of an array of OpenPCDet's; `head` is that of its head on anchors."""
    for pattern, other in _NAMES:
        if match := re.match(pattern + r"(?=\.)", name):
            name = other(match) + name[match.end() :]
            break
    return re.sub(r"^dense_head", head, name)


def _renamed(mapping: KeyMapping, head: str) -> KeyMapping:
    return mapping._replace(source=mmdetection3d_name(mapping.source, head))


def _refuse_old_axes(state: Mapping[str, Tensor]) -> None:
    if FIRST_LINEAR in state and state[FIRST_LINEAR].shape[1:] == (_OLD_FEATURES,):
        raise TrainingError(
            f"{FIRST_LINEAR} has {_OLD_FEATURES} features of a point: trained by mmdetection3d before 1.0, whose boxes "
            "have other axes; give a checkpoint of 1.0 or later"
        )
