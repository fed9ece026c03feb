"""Networks of OpenPCDet and mmdetection3d as ours: other names, and other orders of joined channels.

PV-RCNN: theirs joins a keypoint's features as map, raw points, conv1 to conv4, ours as `settings.sources` and the map;
a channel of their map is channel * height + z, of ours z * channels + channel; their pooled grid is channel-major, ours
has the channels of a grid point side by side.

PointPillars: their points have a tenth feature, the height above the pillar's center. All pillars have the same center
height, so the feature is z less a constant: its weight joins that of z, and the constant joins the mean of the
normalization. An empty slot has zeros in all ten, the height of the center included, and so it keeps its own value
before the normalization.

In mmdetection3d (`legacy`) the offsets to the pillar's center also take the place of x, y and z: their weights join.

mmdetection3d has the networks of OpenPCDet under other names. Its convolutions of a second stage and of set abstraction
are modules with a `conv` and a `bn`, where OpenPCDet counts layers; the layouts of the arrays are the same.

Every array of either side must be matched.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from asca_pillars.base.errors import TrainingError
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.ops.pillar.prepare import FEATURES
from asca_pillars.ops.pv_rcnn.prepare import LEVEL_SOURCES

_NORM_PARTS = ("weight", "bias", "running_mean", "running_var")
_COUNTER = "num_batches_tracked"
_WITHOUT_EFFECT = ("global_step",)  # OpenPCDet's counter of training steps lies beside the weights
_NAMED = 5  # mismatched names in an error, at most


def identity(array: Tensor) -> Tensor:
    """Return weights (out, in, ...), and arrays of any other shape, unchanged."""
    return array


def squeeze_kernel(array: Tensor) -> Tensor:
    """Reshape a 1x1 convolution's weight (out, in, 1, ...) to a linear layer's (out, in)."""
    return array.flatten(1) if array.shape[2:].numel() == 1 else array


class KeyMapping(NamedTuple):
    """Mapping of one array: source name, target name, conversion."""

    source: str
    target: str
    convert: Callable[[Tensor], Tensor] = identity


def norm_keys(source: str, target: str) -> Iterator[KeyMapping]:
    """Return the key mappings of a normalization layer."""
    return (KeyMapping(f"{source}.{part}", f"{target}.{part}") for part in _NORM_PARTS)


def convert_state(
    state: Mapping[str, Tensor], key_mappings: Iterable[KeyMapping], our_state: Mapping[str, Tensor], path_text: str
) -> dict[str, Tensor]:
    """Convert their state dict to ours; every array of theirs is used, or named in the error.

    Args:
        state: theirs by name: weights (out, in, ...) and the (C,) values of normalizations.
        key_mappings: what becomes what.
        our_state: our state dict, for names and shapes.
        path_text: the file, for messages.

    Raises:
        TrainingError: an array is missing, unknown, or of another shape than the configuration asks for.
    """
    key_mappings = list(key_mappings)
    known = {mapping.source for mapping in key_mappings}
    if missing := [name for name in known if name not in state]:
        raise TrainingError(f"{path_text}: lacks {_some(missing)}; the network of --config has other layers")
    if unknown := [name for name in state if name not in known and not _is_counter(name)]:
        raise TrainingError(
            f"{path_text}: {_some(unknown)}: no place for it in the network of --config; nothing is imported in part"
        )
    converted = {}
    for source, target, convert in key_mappings:
        array = convert(state[source])
        if array.shape != our_state[target].shape:
            raise TrainingError(
                f"{path_text}: {source} has shape {tuple(state[source].shape)}, which does not fit {target} "
                f"{tuple(our_state[target].shape)}; give the model's configuration with --config"
            )
        converted[target] = array.to(our_state[target].dtype).contiguous()
    counters = {name: value for name, value in our_state.items() if name.endswith(_COUNTER)}
    assert converted.keys() | counters.keys() == our_state.keys(), "a part of our network has no mapping"
    return counters | converted


def _is_counter(name: str) -> bool:
    return name in _WITHOUT_EFFECT or name.endswith(_COUNTER)


def _some(names: Iterable[str]) -> str:
    names = sorted(names)
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return f"{', '.join(names[:_NAMED])}{more}"


_HEADS = {"scores": "conv_cls", "boxes": "conv_box", "directions": "conv_dir_cls"}


def map_backbone_keys(block_convs: Sequence[int], first: Callable[[Tensor], Tensor] = identity) -> Iterator[KeyMapping]:
    """Yield the key mappings of `backbone_2d` and `dense_head`.

    Args:
        block_convs: convolutions of each block after its first.
        first: conversion of the very first convolution's weight (out, in, 3, 3), whose input channels may
            stand in another order.
    """
    for block, convs in enumerate(block_convs):
        source, target = f"backbone_2d.blocks.{block}", f"neck.blocks.{block}"
        for layer in range(0, 3 * (convs + 1), 3):  # convolution, normalization, ReLU; theirs begins with a padding
            convert = first if block == layer == 0 else identity
            yield KeyMapping(f"{source}.{layer + 1}.weight", f"{target}.{layer}.weight", convert)
            yield from norm_keys(f"{source}.{layer + 2}", f"{target}.{layer + 1}")
        source, target = f"backbone_2d.deblocks.{block}", f"neck.deblocks.{block}"
        yield KeyMapping(f"{source}.0.weight", f"{target}.0.weight")
        yield from norm_keys(f"{source}.1", f"{target}.1")
    for target, source in _HEADS.items():
        for part in ("weight", "bias"):
            yield KeyMapping(f"dense_head.{source}.{part}", f"head.{target}.{part}")


_LAYOUTS = (
    (4, 3, 0, 1, 2),  # kernel, inputs, outputs: 1.x
    (0, 4, 1, 2, 3),  # outputs, kernel, inputs: 2.x
    (3, 4, 0, 1, 2),  # kernel, outputs, inputs: 2.x, weights of its native algorithm
)
"""Position of the axes (out, in, z, y, x) of a dense convolution in each layout."""


def dense_order(pairs: Sequence[tuple[Tensor, Tensor]]) -> Callable[[Tensor], Tensor]:
    """Return the conversion of sparse weights to (out, in, z, y, x), by the layout that fits all of them.

    Layers with as many inputs as outputs fit two of the layouts; all layers of a file have the same.

    Args:
        pairs: of each layer theirs, and ours.
    """
    for axes in _LAYOUTS:
        if all(source.ndim == len(axes) and source.permute(axes).shape == target.shape for source, target in pairs):
            return lambda weight: weight.permute(axes)
    return lambda weight: weight


_Z = FEATURES.index("z")
_X_CENTER, _Z_CENTER = FEATURES.index("x_center"), len(FEATURES)  # the last is the one feature that ours does not have


def pointpillars_keys(model: PillarModel, state: Mapping[str, Tensor]) -> Iterator[KeyMapping]:
    """Yield the mappings for `build_pillar_detector(model)` from `state`, OpenPCDet's weights (out, in, ...).

    Raises:
        TrainingError: points with other features.
    """
    yield from encoder_keys(model, state, "vfe.pfn_layers.0")
    yield from map_backbone_keys(model.network.block_convs)


def encoder_keys(
    model: PillarModel, state: Mapping[str, Tensor], layer: str, *, legacy: bool = False
) -> Iterator[KeyMapping]:
    """Yield the key mappings of the layer on points.

    Args:
        model: ours.
        state: their weights (out, in, ...) by name.
        layer: their name of it.
        legacy: whether the offsets to the pillar's center also stand in the place of x, y and z.

    Raises:
        TrainingError: points with other features.
    """
    name = f"{layer}.linear.weight"
    low_m, high_m = model.spec.grid.z_range_m
    shape = tuple(state[name].shape) if name in state else None
    if shape is not None and (len(shape) != 2 or shape[1] != _Z_CENTER + 1):
        raise TrainingError(
            f"{name} has shape {shape}: its points must have {_Z_CENTER + 1} features, x, y, z, intensity and six "
            "offsets; others cannot be imported"
        )

    def explicit(weight: Tensor) -> Tensor:
        """Return their weight (out, 10) of x, y, z themselves and of their offsets, each once."""
        weight = weight.clone()
        if legacy:
            weight[:, _X_CENTER:] += weight[:, : _Z + 1]
            weight[:, : _Z + 1] = 0
        return weight

    def of_height(weight: Tensor) -> Tensor:
        return explicit(weight)[:, _Z_CENTER] * ((low_m + high_m) / 2)

    def linear(weight: Tensor) -> Tensor:
        merged = explicit(weight)
        merged[:, _Z] += merged[:, _Z_CENTER]
        return merged[:, :_Z_CENTER]

    yield KeyMapping(name, "encode.linear.weight", linear)
    for mapping in norm_keys(f"{layer}.norm", "encode.norm"):
        if mapping.target.endswith("running_mean"):
            yield mapping._replace(convert=lambda mean: mean + of_height(state[name]))
        else:
            yield mapping
    if model.network.empty_slots:
        yield KeyMapping(name, "encode.empty_slot", of_height)


FIRST_CONVOLUTION = "backbone_3d.conv_input.0.weight"
_JOINED = ("points", *LEVEL_SOURCES)  # after the map


def pv_rcnn_keys(
    model: PvRcnnModel, state: Mapping[str, Tensor], our_state: Mapping[str, Tensor]
) -> Iterator[KeyMapping]:
    """Yield the key mappings for `build_pv_rcnn(model)` without extensions by later papers.

    Args:
        model: ours.
        state: their weights (out, in, ...) by name.
        our_state: ours, likewise.
    """
    yield from _voxel_keys(state, our_state)
    yield from map_backbone_keys(model.network.block_convs, _channels_of(_map_order(model)))
    yield from _keypoint_keys(model)
    yield from _refine_keys(model)


def _voxel_keys(state: Mapping[str, Tensor], our_state: Mapping[str, Tensor]) -> Iterator[KeyMapping]:
    layers = {"conv_input": "same.0.0", "conv1.0": "same.0.1", "conv_out": "down.3"}
    for level in range(1, len(LEVEL_SOURCES)):
        names = (f"down.{level - 1}", f"same.{level}.0", f"same.{level}.1")
        layers |= {f"conv{level + 1}.{number}": name for number, name in enumerate(names)}
    weights = {
        f"backbone_3d.{source}.0.weight": f"voxels.{target}.convolution.weight" for source, target in layers.items()
    }
    convert = dense_order([(state[source], our_state[target]) for source, target in weights.items() if source in state])
    yield from (KeyMapping(source, target, convert) for source, target in weights.items())
    for source, target in layers.items():
        yield from norm_keys(f"backbone_3d.{source}.1", f"voxels.{target}.norm")


def _keypoint_keys(model: PvRcnnModel) -> Iterator[KeyMapping]:
    ball = 0
    for sa, widths in zip(model.settings.sources, model.network.source_widths, strict=True):
        level = "SA_rawpoints" if sa.source == "points" else f"SA_layers.{_level(model, sa.source)}"
        for radius in range(len(sa.radii_m)):
            yield from _ball_keys(f"pfe.{level}.mlps.{radius}", f"encode.balls.{ball}", len(widths))
            ball += 1
    joined = _channels_of(_joined_order(model))
    yield KeyMapping("pfe.vsa_point_feature_fusion.0.weight", "encode.fuse.0.weight", joined)
    yield from norm_keys("pfe.vsa_point_feature_fusion.1", "encode.fuse.1")
    for layer in (0, 3):
        convert = joined if layer == 0 else squeeze_kernel
        yield KeyMapping(f"point_head.cls_layers.{layer}.weight", f"encode.weigh.{layer}.weight", convert)
        yield from norm_keys(f"point_head.cls_layers.{layer + 1}", f"encode.weigh.{layer + 1}")
    for part in ("weight", "bias"):
        yield KeyMapping(f"point_head.cls_layers.6.{part}", f"encode.weigh.6.{part}")


def _refine_keys(model: PvRcnnModel) -> Iterator[KeyMapping]:
    widths, radii = model.network.grid_widths, len(model.settings.grid_radii_m)
    for radius in range(radii):
        source = f"roi_head.roi_grid_pool_layer.mlps.{radius}"
        yield from _ball_keys(source, f"refine.pools.{radius}", len(widths))
    cells, channels = model.settings.grid_size**3, radii * widths[-1]
    order = torch.arange(cells * channels).view(channels, cells).T.flatten()
    dropout = bool(model.network.dropout)  # without it ours has no layer for it
    for source, target in (("shared_fc_layer", "shared"), ("cls_layers", "confidence"), ("reg_layers", "residuals")):
        for layer in (0, 4):  # linear, normalization, ReLU, dropout
            convert = _channels_of(order) if (source, layer) == ("shared_fc_layer", 0) else squeeze_kernel
            target_layer = 3 + dropout if layer else 0
            yield KeyMapping(f"roi_head.{source}.{layer}.weight", f"refine.{target}.{target_layer}.weight", convert)
            yield from norm_keys(f"roi_head.{source}.{layer + 1}", f"refine.{target}.{target_layer + 1}")
        if source != "shared_fc_layer":
            last = f"refine.{target}.{6 + dropout}"
            yield KeyMapping(f"roi_head.{source}.7.weight", f"{last}.weight", squeeze_kernel)
            yield KeyMapping(f"roi_head.{source}.7.bias", f"{last}.bias")


def _ball_keys(source: str, target: str, layers: int) -> Iterator[KeyMapping]:
    for number in range(layers):
        yield KeyMapping(f"{source}.{3 * number}.weight", f"{target}.layers.{number}.weight", squeeze_kernel)
        yield from norm_keys(f"{source}.{3 * number + 1}", f"{target}.norms.{number}")


def _level(model: PvRcnnModel, source: str) -> int:
    levels = [name for name in LEVEL_SOURCES if name in {sa.source for sa in model.settings.sources}]
    return levels.index(source)  # type: ignore[arg-type]


def _map_order(model: PvRcnnModel) -> Tensor:
    """Return for each channel of our map the index of OpenPCDet's."""
    height, channels = model.spec.level_shapes[-1][0], model.network.voxel_channels[-1]
    return torch.arange(height * channels).view(channels, height).T.flatten()


def _joined_order(model: PvRcnnModel) -> Tensor:
    """Return for each of our joined channels of a keypoint the index of OpenPCDet's."""
    of_map = _map_order(model)
    widths = {
        sa.source: len(sa.radii_m) * widths[-1]
        for sa, widths in zip(model.settings.sources, model.network.source_widths, strict=True)
    }
    starts, start = {}, len(of_map)
    for source in _JOINED:
        starts[source] = start
        start += widths.get(source, 0)
    orders = [torch.arange(widths[sa.source]) + starts[sa.source] for sa in model.settings.sources]
    return torch.cat([*orders, of_map])


def _channels_of(order: Tensor) -> Callable[[Tensor], Tensor]:
    """Reorder input channels, and drop singleton axes behind them unless it is a convolution's kernel."""

    def convert(weight: Tensor) -> Tensor:
        weight = squeeze_kernel(weight)
        return weight[:, order] if weight.shape[1] == len(order) else weight

    return convert


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
        state: their weights (out, in, ...) by name.
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
