"""The trained sparse neck and head as a chain of matrix products, the form that its graph has.

A batch normalization is part of the weights before it. A convolution by table reads the rows of its taps side by side,
so it is one product; an upsampling whose kernel equals its stride is one product for each active parent, whose
outputs are then picked at head cells; the head's three convolutions are one product.
"""

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from asca_deploy.pillar.graphs import PILLAR_FEATURES
from asca_export.fast_forms import STEP_VALUE, CanvasSteps
from asca_export.quantize import HEAD
from asca_export.row_graphs import RowGraph
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.models.pillar.neck import SparseRPNNeck, block_layers
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.ops.pillar.neck_rulebooks import SAME, NeckRulebooks, rulebook_inputs


class NeckProduct(NamedTuple):
    """A convolution by table, followed by a ReLU."""

    name: str
    """Name of its product in `SparseBackbone.products`."""
    table: str
    """The input of the graph that it gathers by."""


class Level(NamedTuple):
    """One block of the neck, and what brings its rows to the head cells."""

    convolutions: tuple[NeckProduct, ...]
    upsample: str
    places: str
    """The input of the graph that picks the upsampling's rows."""
    stride: int
    """Stride of the upsampling."""


class SparseBackbone(nn.Module):
    """Sparse neck and head of a trained detector as matrix products by name.

    Args:
        detector: in evaluation mode, with a sparse neck; not modified.
        steps: of the pillar features, which then hold STEP_VALUE times the step; None for real values.
    """

    def __init__(self, detector: PillarDetector, steps: CanvasSteps | None = None) -> None:
        super().__init__()
        neck = detector.neck
        assert isinstance(neck, SparseRPNNeck)
        self.products = nn.ModuleDict()
        self.levels: list[Level] = []
        for number, (block, deblock) in enumerate(zip(neck.blocks, neck.deblocks, strict=True)):
            grows = neck.rule == "fine" and number == 0
            convolutions = []
            for index, (convolution, norm) in enumerate(block_layers(block)):
                assert isinstance(convolution, nn.Conv2d)
                fused = fuse_conv_bn_eval(convolution, norm)
                kind = ("strided", "first" if grows else "same", "same")[min(index, 2)]
                layer = NeckProduct(f"block{number}_{index}", f"{kind}_{number}")
                self.products[layer.name] = linear(fused.weight.flatten(2).transpose(1, 2).flatten(1), fused.bias)
                convolutions.append(layer)
            ((transposed, norm),) = block_layers(deblock)
            assert isinstance(transposed, nn.ConvTranspose2d)
            fused_up = fuse_conv_bn_eval(transposed, norm, transpose=True)
            assert fused_up.bias is not None
            stride, upsample = fused_up.stride[0], f"upsample{number}"
            weight = fused_up.weight.permute(2, 3, 1, 0).flatten(0, 2)  # (row, column, channel), inputs
            self.products[upsample] = linear(weight, fused_up.bias.repeat(stride**2))
            self.levels.append(Level(tuple(convolutions), upsample, f"places_{number}", stride))
        self.products[HEAD] = linear(*detector.head.joined())
        self.head_channels = detector.head.channels
        first = self.product(self.levels[0].convolutions[0].name)
        self.channels = first.in_features // SAME.taps
        self.empty = torch.zeros(self.channels) if steps is None else steps.empty
        """(C,) what the first layer reads where there is no pillar; in steps if there are any."""
        if steps is not None:
            with torch.no_grad():
                first.weight.view(-1, SAME.taps, self.channels).mul_(steps.scale / STEP_VALUE)
                first.bias.sub_(first.weight @ (steps.empty * STEP_VALUE).repeat(SAME.taps))

    def product(self, name: str) -> nn.Linear:
        """Return the product of this name: weight (outputs, taps * C) with the channels of a tap side by side."""
        product = self.products[name]
        assert isinstance(product, nn.Linear)
        return product

    def passes(self, features: Tensor, rulebooks: NeckRulebooks[Tensor]) -> Iterator[tuple[str, Tensor, Tensor]]:
        """Yield name, input and output of each product in turn: unitless (P, C), or STEP_VALUE times steps."""
        inputs, maps = rulebook_inputs(rulebooks), []
        missing = self.empty * STEP_VALUE
        for level in self.levels:
            for layer in level.convolutions:
                padded = torch.cat([features, missing[None]])
                read = padded[inputs[layer.table].long()].flatten(1)
                features = torch.relu(self.product(layer.name)(read))
                missing = features.new_zeros(features.shape[1])
                yield layer.name, read, features
            upsampled = torch.relu(self.product(level.upsample)(features))
            yield level.upsample, features, upsampled
            channels = upsampled.shape[1] // level.stride**2
            rows = torch.cat([upsampled.view(-1, channels), upsampled.new_zeros(1, channels)])
            maps.append(rows[inputs[level.places].long()])
        joined = torch.cat(maps, dim=1)
        yield HEAD, joined, self.product(HEAD)(joined)

    def forward(self, features: Tensor, rulebooks: NeckRulebooks[Tensor]) -> HeadMaps[Tensor]:
        """Run: pillar features (P, C) -> scores (H, A), boxes (H, 7A), directions (H, 2A) at H head cells."""
        for _, _, output in self.passes(features, rulebooks):
            last = output
        return HeadMaps(*last.split(self.head_channels, dim=1))


def scale_and_shift(norm: nn.BatchNorm1d) -> tuple[Tensor, Tensor]:
    """Return the scale and shift of a normalization in evaluation mode, (C,) each."""
    assert norm.running_var is not None and norm.running_mean is not None
    scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
    return scale, norm.bias - norm.running_mean * scale


def linear(weight: Tensor, bias: Tensor | None) -> nn.Linear:
    """Return a frozen product with this unitless weight (outputs, n) and bias (outputs,)."""
    assert bias is not None
    product = nn.Linear(weight.shape[1], weight.shape[0])
    with torch.no_grad():
        product.weight.copy_(weight)
        product.bias.copy_(bias)
    return product.requires_grad_(False)


JOINED = f"{HEAD}.joined"
"""Inputs of the head's product, by name."""


def export_sparse_backbone(
    backbone: SparseBackbone, path: Path, eight_bit: Collection[str] = (), *, steps: bool = False
) -> None:
    """Write the graph: pillar features (P, C) and the int32 rulebooks -> scores, boxes, directions of each head cell.

    Args:
        backbone: made with canvas steps and scaled to steps, if `steps`.
        path: of the file.
        eight_bit: products that compute in 8 bits, their weights already rounded; others in float.
        steps: rows are uint8 steps rather than float32.
    """
    graph, maps = RowGraph(backbone.product, eight_bit), []
    row_type = np.dtype(np.uint8 if steps else np.float32)
    rows = graph.add_input(PILLAR_FEATURES, helper.np_dtype_to_tensor_dtype(row_type), "pillars", backbone.channels)
    missing = backbone.empty.numpy().astype(row_type)
    for level in backbone.levels:
        for layer in level.convolutions:
            taps = backbone.product(layer.name).in_features // len(missing)
            read = graph.gather(layer.name, rows, missing, layer.table, taps)
            rows = graph.relu(layer.name, graph.product(layer.name, read, steps=steps), steps=steps)
            missing = np.zeros(backbone.product(layer.name).out_features, row_type)
        channels = backbone.product(level.upsample).out_features // level.stride**2
        upsampled = graph.relu(level.upsample, graph.product(level.upsample, rows, steps=steps), steps=steps)
        maps.append(graph.reshape(level.upsample, "pixels", upsampled, channels))
    joined = _joined(graph, maps, [level.places for level in backbone.levels], np.zeros((1, channels), row_type))
    outputs = graph.product(HEAD, joined, steps=steps)
    sizes = graph.constant(HEAD, "channels", np.array(backbone.head_channels, np.int64))
    graph.named("Split", HeadMaps._fields, outputs, sizes, axis=1)
    for name, channels in zip(HeadMaps._fields, backbone.head_channels, strict=True):
        graph.add_output(name, TensorProto.FLOAT, "head_cells", channels)
    graph.save(path, "sparse_backbone")


def sparse_multiply_accumulates(backbone: SparseBackbone, rulebooks: NeckRulebooks[NDArray[np.int32]]) -> int:
    """Count the multiply-accumulates of the products on the scan of these rulebooks, indices (M, 9)."""
    inputs, total = rulebook_inputs(rulebooks), 0
    for level in backbone.levels:
        for layer in level.convolutions:
            rows = len(inputs[layer.table])
            total += rows * backbone.product(layer.name).weight.numel()
        total += rows * backbone.product(level.upsample).weight.numel()
    return total + len(rulebooks.head_cells) * backbone.product(HEAD).weight.numel()


def _joined(graph: RowGraph, maps: Sequence[str], places: Sequence[str], missing: NDArray[np.generic]) -> str:
    """Return rows of several maps, picked by places (H,) of each, side by side: (H, maps * channels).

    Uses one gather from all maps, concatenated with the row `missing` (1, channels) behind each: the results of one
    gather per map would have to be copied again to stand side by side.
    """
    rows, indices, first = [], [], ""
    for number, (values, place) in enumerate(zip(maps, places, strict=True)):
        owner = f"head{number}"
        graph.add_input(place, TensorProto.INT32, "head_cells")
        rows += [values, graph.constant(owner, "missing", missing)]
        if number:
            size = graph.node("Shape", owner, "size", maps[number - 1], start=0, end=1)
            count = graph.node("Cast", owner, "count", size, to=TensorProto.INT32)
            after = graph.node("Add", owner, "after", count, graph.constant(owner, "one", np.array([1], np.int32)))
            first = graph.node("Add", owner, "first", first, after) if first else after
        indices.append(graph.node("Add", owner, "places", place, first) if first else place)
    by_map = graph.reshape(HEAD, "by_map", graph.node("Concat", HEAD, "places", *indices, axis=0), -1, len(maps))
    by_cell = graph.node("Transpose", HEAD, "by_cell", by_map)  # (H, maps)
    gathered = graph.node("Gather", HEAD, "gathered", graph.node("Concat", HEAD, "maps", *rows, axis=0), by_cell)
    return graph.reshape(HEAD, "joined", gathered, len(maps) * missing.shape[1])
