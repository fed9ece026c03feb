"""OpenPCDet's PV-RCNN as ours: other names, and other orders of channels where they are joined.

Theirs joins a keypoint's features as map, raw points, conv1 to conv4, ours as `settings.sources` and the map; a channel
of their map is channel * height + z, of ours z * channels + channel; their pooled grid is channel-major, ours has the
channels of a grid point side by side.
"""

from collections.abc import Callable, Iterator, Mapping

import torch
from torch import Tensor

from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.models.openpcdet.key_mapping import (
    KeyMapping,
    dense_order,
    map_backbone_keys,
    norm_keys,
    squeeze_kernel,
)
from asca_pillars.ops.pv_rcnn.prepare import LEVEL_SOURCES

FIRST_CONVOLUTION = "backbone_3d.conv_input.0.weight"
_JOINED = ("points", *LEVEL_SOURCES)  # after the map


def pv_rcnn_keys(
    model: PvRcnnModel, state: Mapping[str, Tensor], our_state: Mapping[str, Tensor]
) -> Iterator[KeyMapping]:
    """Yield the key mappings for `build_pv_rcnn(model)` without extensions by later papers.

    Args:
        model: ours.
        state: their unitless weights (out, in, ...) by name.
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
    weights = {f"backbone_3d.{there}.0.weight": f"voxels.{here}.convolution.weight" for there, here in layers.items()}
    convert = dense_order([(state[there], our_state[here]) for there, here in weights.items() if there in state])
    yield from (KeyMapping(there, here, convert) for there, here in weights.items())
    for there, here in layers.items():
        yield from norm_keys(f"backbone_3d.{there}.1", f"voxels.{here}.norm")


def _keypoint_keys(model: PvRcnnModel) -> Iterator[KeyMapping]:
    ball = 0
    for each, widths in zip(model.settings.sources, model.network.source_widths, strict=True):
        level = "SA_rawpoints" if each.source == "points" else f"SA_layers.{_level(model, each.source)}"
        for radius in range(len(each.radii_m)):
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
        there = f"roi_head.roi_grid_pool_layer.mlps.{radius}"
        yield from _ball_keys(there, f"refine.pools.{radius}", len(widths))
    cells, channels = model.settings.grid_size**3, radii * widths[-1]
    order = torch.arange(cells * channels).view(channels, cells).T.flatten()
    dropout = bool(model.network.dropout)  # without it ours has no layer for it
    for there, here in (("shared_fc_layer", "shared"), ("cls_layers", "confidence"), ("reg_layers", "residuals")):
        for layer in (0, 4):  # linear, normalization, ReLU, dropout
            convert = _channels_of(order) if (there, layer) == ("shared_fc_layer", 0) else squeeze_kernel
            own = 3 + dropout if layer else 0
            yield KeyMapping(f"roi_head.{there}.{layer}.weight", f"refine.{here}.{own}.weight", convert)
            yield from norm_keys(f"roi_head.{there}.{layer + 1}", f"refine.{here}.{own + 1}")
        if there != "shared_fc_layer":
            last = f"refine.{here}.{6 + dropout}"
            yield KeyMapping(f"roi_head.{there}.7.weight", f"{last}.weight", squeeze_kernel)
            yield KeyMapping(f"roi_head.{there}.7.bias", f"{last}.bias")


def _ball_keys(there: str, here: str, layers: int) -> Iterator[KeyMapping]:
    for number in range(layers):
        yield KeyMapping(f"{there}.{3 * number}.weight", f"{here}.layers.{number}.weight", squeeze_kernel)
        yield from norm_keys(f"{there}.{3 * number + 1}", f"{here}.norms.{number}")


def _level(model: PvRcnnModel, source: str) -> int:
    levels = [name for name in LEVEL_SOURCES if name in {each.source for each in model.settings.sources}]
    return levels.index(source)  # type: ignore[arg-type]


def _map_order(model: PvRcnnModel) -> Tensor:
    """Return for each channel of our map the index of OpenPCDet's."""
    height, channels = model.spec.level_shapes[-1][0], model.network.voxel_channels[-1]
    return torch.arange(height * channels).view(channels, height).T.flatten()


def _joined_order(model: PvRcnnModel) -> Tensor:
    """Return for each of our joined channels of a keypoint the index of OpenPCDet's."""
    of_map = _map_order(model)
    widths = {
        each.source: len(each.radii_m) * widths[-1]
        for each, widths in zip(model.settings.sources, model.network.source_widths, strict=True)
    }
    starts, start = {}, len(of_map)
    for source in _JOINED:
        starts[source] = start
        start += widths.get(source, 0)
    own = [torch.arange(widths[each.source]) + starts[each.source] for each in model.settings.sources]
    return torch.cat([*own, of_map])


def _channels_of(order: Tensor) -> Callable[[Tensor], Tensor]:
    """Reorder input channels, and drop singleton axes behind them unless it is a convolution's kernel."""

    def convert(weight: Tensor) -> Tensor:
        weight = squeeze_kernel(weight)
        return weight[:, order] if weight.shape[1] == len(order) else weight

    return convert
