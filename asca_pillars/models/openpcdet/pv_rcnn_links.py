"""OpenPCDet's PV-RCNN as ours: other names, and other orders of channels where they are joined.

Theirs joins a keypoint's features as map, raw points, conv1 to conv4, ours as `settings.sources` and the map; a channel
of their map is channel * height + z, of ours z * channels + channel; their pooled grid is channel-major, ours has the
channels of a grid point side by side.
"""

from collections.abc import Callable, Iterator, Mapping

import torch
from torch import Tensor

from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.models.openpcdet.links import Link, dense_order, map_links, norm_links, without_singletons
from asca_pillars.ops.pv_rcnn.prepare import LEVEL_SOURCES

FIRST_CONVOLUTION = "backbone_3d.conv_input.0.weight"
_JOINED = ("points", *LEVEL_SOURCES)  # after the map


def pv_rcnn_links(model: PvRcnnModel, state: Mapping[str, Tensor], wanted: Mapping[str, Tensor]) -> Iterator[Link]:
    """Yield the links for `build_pv_rcnn(model)` without extensions by later papers.

    Args:
        model: ours.
        state: their unitless weights (out, in, ...) by name.
        wanted: ours, likewise.
    """
    yield from _voxel_links(state, wanted)
    yield from map_links(model.network.block_convs, _channels_of(_map_order(model)))
    yield from _keypoint_links(model)
    yield from _refine_links(model)


def _voxel_links(state: Mapping[str, Tensor], wanted: Mapping[str, Tensor]) -> Iterator[Link]:
    layers = {"conv_input": "same.0.0", "conv1.0": "same.0.1", "conv_out": "down.3"}
    for level in range(1, len(LEVEL_SOURCES)):
        names = (f"down.{level - 1}", f"same.{level}.0", f"same.{level}.1")
        layers |= {f"conv{level + 1}.{number}": name for number, name in enumerate(names)}
    weights = {f"backbone_3d.{there}.0.weight": f"voxels.{here}.convolution.weight" for there, here in layers.items()}
    convert = dense_order([(state[there], wanted[here]) for there, here in weights.items() if there in state])
    yield from (Link(there, here, convert) for there, here in weights.items())
    for there, here in layers.items():
        yield from norm_links(f"backbone_3d.{there}.1", f"voxels.{here}.norm")


def _keypoint_links(model: PvRcnnModel) -> Iterator[Link]:
    ball = 0
    for each, widths in zip(model.settings.sources, model.network.source_widths, strict=True):
        level = "SA_rawpoints" if each.source == "points" else f"SA_layers.{_level(model, each.source)}"
        for radius in range(len(each.radii_m)):
            yield from _ball_links(f"pfe.{level}.mlps.{radius}", f"encode.balls.{ball}", len(widths))
            ball += 1
    joined = _channels_of(_joined_order(model))
    yield Link("pfe.vsa_point_feature_fusion.0.weight", "encode.fuse.0.weight", joined)
    yield from norm_links("pfe.vsa_point_feature_fusion.1", "encode.fuse.1")
    for layer in (0, 3):
        convert = joined if layer == 0 else without_singletons
        yield Link(f"point_head.cls_layers.{layer}.weight", f"encode.weigh.{layer}.weight", convert)
        yield from norm_links(f"point_head.cls_layers.{layer + 1}", f"encode.weigh.{layer + 1}")
    for part in ("weight", "bias"):
        yield Link(f"point_head.cls_layers.6.{part}", f"encode.weigh.6.{part}")


def _refine_links(model: PvRcnnModel) -> Iterator[Link]:
    widths, radii = model.network.grid_widths, len(model.settings.grid_radii_m)
    for radius in range(radii):
        there = f"roi_head.roi_grid_pool_layer.mlps.{radius}"
        yield from _ball_links(there, f"refine.pools.{radius}", len(widths))
    cells, channels = model.settings.grid_size**3, radii * widths[-1]
    order = torch.arange(cells * channels).view(channels, cells).T.flatten()
    dropout = bool(model.network.dropout)  # without it ours has no layer for it
    for there, here in (("shared_fc_layer", "shared"), ("cls_layers", "confidence"), ("reg_layers", "residuals")):
        for layer in (0, 4):  # linear, normalization, ReLU, dropout
            convert = _channels_of(order) if (there, layer) == ("shared_fc_layer", 0) else without_singletons
            own = 3 + dropout if layer else 0
            yield Link(f"roi_head.{there}.{layer}.weight", f"refine.{here}.{own}.weight", convert)
            yield from norm_links(f"roi_head.{there}.{layer + 1}", f"refine.{here}.{own + 1}")
        if there != "shared_fc_layer":
            last = f"refine.{here}.{6 + dropout}"
            yield Link(f"roi_head.{there}.7.weight", f"{last}.weight", without_singletons)
            yield Link(f"roi_head.{there}.7.bias", f"{last}.bias")


def _ball_links(there: str, here: str, layers: int) -> Iterator[Link]:
    for number in range(layers):
        yield Link(f"{there}.{3 * number}.weight", f"{here}.layers.{number}.weight", without_singletons)
        yield from norm_links(f"{there}.{3 * number + 1}", f"{here}.norms.{number}")


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
        weight = without_singletons(weight)
        return weight[:, order] if weight.shape[1] == len(order) else weight

    return convert
