"""The trained sparse neck and head as a chain of matrix products, the form that its graph has.

A batch normalization is part of the weights before it. A sparse convolution reads the rows of its taps side by side, so
it is one product; an upsampling whose kernel equals its stride is one product for each active parent, whose outputs are
then picked at head cells; the head's three convolutions are one product.

In ONNX a layer is Concat (row of zeros), Gather, Reshape, Gemm, Relu.

In 8 bits all rows are uint8 from one Gemm to the next. Gemm stands between DequantizeLinear and QuantizeLinear, which
runtimes join into one integer operator; the quantization's zero point is the ReLU.

Rounding is as in `quantize` for the dense neck; here no empty space has to be rounded. A channel's step is its largest
value on the calibration scans / 255. Weights are rounded together (GPTQ), and the bias makes up for what rounding
changes in the mean. The head's weights are rounded for the cells with the highest scores, which boxes are decoded from.
"""

import copy
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from asca_deploy.pillar.graphs import PILLAR_FEATURES
from asca_export.fast_forms import STEP_VALUE, CanvasSteps
from asca_export.graphs import OPSET
from asca_export.quantize import HEAD, PLACES, STEPS, TINY, WEIGHT_STEPS, round_together
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.models.pillar.neck import SparseRPNNeck, block_layers
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.ops.pillar.neck_rulebooks import SAME, NeckRulebooks, rulebook_inputs

_TINY = 1e-12


class RowGraph:
    """Builder of a graph's nodes and constants; methods return the name of their result.

    Args:
        product: a layer's weights by its name, rounded already for those of `eight_bit`.
        eight_bit: products that compute in 8 bits.
    """

    def __init__(self, product: Callable[[str], nn.Linear], eight_bit: Collection[str]) -> None:
        self._product, self._eight_bit = product, frozenset(eight_bit)
        self._nodes: list[onnx.NodeProto] = []
        self._constants: dict[str, NDArray[Any]] = {}
        self._inputs: dict[str, onnx.ValueInfoProto] = {}
        self._outputs: list[onnx.ValueInfoProto] = []

    def add_input(self, name: str, kind: int, rows: str, width: int | None = None) -> str:
        """Declare an input (rows, width), or (rows,)."""
        self._inputs[name] = helper.make_tensor_value_info(name, kind, [rows] if width is None else [rows, width])
        return name

    def add_output(self, name: str, kind: int, rows: str, width: int) -> None:
        """Declare a node's result (rows, width) an output."""
        self._outputs.append(helper.make_tensor_value_info(name, kind, [rows, width]))

    def gather(self, owner: str, rows: str, missing: NDArray[Any], rulebook: str, taps: int) -> str:
        """Gather rows by the rulebook (M, taps), the row `missing` (C,) behind the last: (M, taps * C)."""
        self.add_input(rulebook, TensorProto.INT32, f"{rulebook}_rows", taps)
        padded = self.node("Concat", owner, "padded", rows, self.constant(owner, "missing", missing[None]), axis=0)
        gathered = self.node("Gather", owner, "gathered", padded, rulebook, axis=0)
        return self.reshape(owner, "rows", gathered, taps * len(missing))

    def reshape(self, owner: str, what: str, rows: str, width: int, count: int = -1) -> str:
        """Reshape to (count, width)."""
        return self.node("Reshape", owner, what, rows, self.constant(owner, f"{what}_shape", np.array([count, width])))

    def product(self, name: str, rows: str, *, steps: bool) -> str:
        """Add a Gemm on rows that are uint8 `steps` or floating point."""
        product = self._product(name)
        weight, bias = product.weight.numpy(), product.bias.numpy()
        if steps:
            rows = self.in_float(name, "input", rows)
        if name in self._eight_bit:
            matrix, offset = self._rounded(name, weight, bias)
        else:
            matrix = self.constant(name, "weight", np.ascontiguousarray(weight.T))
            offset = self.constant(name, "bias", bias)
        return self.node("Gemm", name, "product", rows, matrix, offset)

    def relu(self, name: str, results: str, *, steps: bool) -> str:
        """Add the ReLU of a product, with results in uint8 `steps` or in floating point."""
        results = self.node("Relu", name, "relu", results)
        return self.node("QuantizeLinear", name, "steps", results, *self._step(name)) if steps else results

    def in_float(self, owner: str, what: str, steps: str) -> str:
        """Dequantize uint8 steps to STEP_VALUE times the step."""
        return self._dequantized(owner, what, steps, *self._step(owner))

    def node(self, kind: str, owner: str, what: str, *inputs: str, **attributes: int) -> str:
        """Add one operator."""
        name = f"{owner}.{what}"
        self._nodes.append(helper.make_node(kind, list(inputs), [name], name=name, **attributes))
        return name

    def named(self, kind: str, outputs: Sequence[str], *inputs: str, **attributes: int) -> None:
        """Add one operator with results of these names."""
        self._nodes.append(helper.make_node(kind, list(inputs), list(outputs), name=f"{outputs[0]}.last", **attributes))

    def constant(self, owner: str, what: str, value: NDArray[Any]) -> str:
        """Add an initializer (any shape)."""
        name = f"{owner}.{what}"
        self._constants[name] = value
        return name

    def save(self, path: Path, title: str) -> None:
        """Check and write the graph."""
        constants = [numpy_helper.from_array(value, name) for name, value in self._constants.items()]
        graph = helper.make_graph(self._nodes, title, list(self._inputs.values()), self._outputs, constants)
        model = helper.make_model(
            graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=10, producer_name="asca_export"
        )
        onnx.checker.check_model(model, full_check=True)
        onnx.save(model, path)

    def _rounded(self, name: str, weight: NDArray[np.float32], bias: NDArray[np.float32]) -> tuple[str, str]:
        unit = np.maximum(np.abs(weight).max(axis=1) / WEIGHT_STEPS, _TINY).astype(np.float32)
        whole = np.round(weight / unit[:, None]).astype(np.int8)
        bias_unit = unit * np.float32(STEP_VALUE)
        limit = float(np.iinfo(np.int32).max // 2)
        whole_bias = np.clip(np.round(bias.astype(np.float64) / bias_unit), -limit, limit).astype(np.int32)
        weight_scale = self.constant(name, "weight_unit", unit), self.constant(name, "weight_zero", 0 * whole[:, 0])
        bias_scale = self.constant(name, "bias_unit", bias_unit), self.constant(name, "bias_zero", 0 * whole_bias)
        matrix = self.constant(name, "weight_steps", np.ascontiguousarray(whole.T))
        offset = self.constant(name, "bias_steps", whole_bias)
        return (
            self._dequantized(name, "weight", matrix, *weight_scale, axis=1),
            self._dequantized(name, "bias", offset, *bias_scale, axis=0),
        )

    def _step(self, owner: str) -> tuple[str, str]:
        step = self.constant(owner, "step", np.array(STEP_VALUE, np.float32))
        return step, self.constant(owner, "zero", np.array(0, np.uint8))

    def _dequantized(self, owner: str, what: str, value: str, *scale: str, **axis: int) -> str:
        return self.node("DequantizeLinear", owner, f"{what}_values", value, *scale, **axis)


class NeckProduct(NamedTuple):
    """A sparse convolution, followed by a ReLU."""

    name: str
    """Name of its product in `SparseBackbone.products`."""
    rulebook: str
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
        """Yield name, input and output of each product in turn: (P, C), or STEP_VALUE times steps."""
        inputs, maps = rulebook_inputs(rulebooks), []
        missing = self.empty * STEP_VALUE
        for level in self.levels:
            for layer in level.convolutions:
                padded = torch.cat([features, missing[None]])
                read = padded[inputs[layer.rulebook].long()].flatten(1)
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
    """Return a frozen product with this weight (outputs, n) and bias (outputs,)."""
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
            read = graph.gather(layer.name, rows, missing, layer.rulebook, taps)
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
            rows = len(inputs[layer.rulebook])
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


BEST_CELLS = 32  # highest-scoring cells of each scan and anchor for rounding the head
OTHER_CELLS = 64  # other cells of each scan, so that background scores stay low


class SparseSample(NamedTuple):
    """Inputs of the backbone for one scan."""

    features: Tensor
    """(P, C) pillar features."""
    rulebooks: NeckRulebooks[Tensor]

    def quantize_features(self, steps: CanvasSteps) -> "SparseSample":
        """Return the sample with features rounded to whole steps, times STEP_VALUE."""
        whole = (self.features / steps.scale + steps.empty).round().clamp(0, STEPS)
        return self._replace(features=whole * STEP_VALUE)


class RowProducts(Protocol):
    """Matrix products by name, one after the other."""

    products: nn.ModuleDict

    def product(self, name: str) -> nn.Linear:
        """Return the product of this name."""

    def passes(self, *sample: Any) -> Iterator[tuple[str, Tensor, Tensor]]:
        """Yield name, input (M, n) and output (M, outputs) of each product in turn."""


Backbone = TypeVar("Backbone", bound=RowProducts)


class InputMoments(NamedTuple):
    """Moments of a product's inputs: mean (n,), and mean product of the differences from it (n, n)."""

    mean: Tensor
    squares: Tensor


@torch.no_grad()
def scale_rows_to_steps(backbone: SparseBackbone, samples: Iterable[SparseSample]) -> None:
    """Change the weights so that rows count steps, 0 to 255 times STEP_VALUE; the results stay the same.

    Args:
        backbone: made with the steps of the samples; changed in place.
        samples: of the calibration scans, in steps.
    """
    highest = highest_outputs(backbone, samples)
    head, first_channel = backbone.product(HEAD), 0
    names = [[layer.name for layer in level.convolutions] for level in backbone.levels]
    for number, level in enumerate(backbone.levels):
        following = [*names[number][1:], None]
        for name, next_name in zip(names[number], following, strict=True):
            step = highest[name].clamp_min(TINY) / STEPS
            count_steps(backbone.product(name), step)
            readers = [next_name] if next_name else [level.upsample, *(block[0] for block in names[number + 1 :][:1])]
            for reader in readers:
                weight = backbone.product(reader).weight
                weight.view(len(weight), -1, len(step)).mul_(step / STEP_VALUE)
        channels = len(highest[level.upsample]) // level.stride**2  # the places of a channel end up in one column
        step = highest[level.upsample].view(-1, channels).amax(dim=0).clamp_min(TINY) / STEPS
        count_steps(backbone.product(level.upsample), step.repeat(level.stride**2))
        head.weight[:, first_channel : first_channel + channels] *= step / STEP_VALUE
        first_channel += channels


def highest_outputs(backbone: RowProducts, samples: Iterable[tuple[Any, ...]]) -> dict[str, Tensor]:
    """Return the largest value (C,) of each channel of what every product gives, by name; at least 0."""
    highest: dict[str, Tensor] = {}
    for sample in samples:
        for name, _, output in backbone.passes(*sample):
            before = highest.get(name, output.new_zeros(output.shape[1]))
            highest[name] = torch.cat([output, before[None]]).amax(dim=0)
    return highest


@torch.no_grad()
def read_moments(
    backbone: RowProducts, samples: Sequence[tuple[Any, ...]], places: int = PLACES
) -> dict[str, InputMoments]:
    """Return moments of what every product reads on the calibration scans, at so many places of each at most.

    A head's are those of the cells with its highest scores, and of a few others.
    """
    generator = torch.Generator().manual_seed(0)
    sums: dict[str, tuple[Tensor, Tensor]] = {}
    for sample in samples:
        for name, read, output in backbone.passes(*sample):
            chosen = torch.randperm(len(read), generator=generator)[:places]
            if name == HEAD and isinstance(backbone, SparseBackbone):
                scores = output[:, : backbone.head_channels[0]]
                best = scores.topk(min(BEST_CELLS, len(scores)), dim=0).indices.flatten()
                chosen = torch.cat([best, chosen[:OTHER_CELLS]])
            rows = read[chosen].double()
            mean, squares = rows.sum(dim=0) / max(len(rows), 1), rows.T @ rows / max(len(rows), 1)
            before = sums.get(name, (torch.zeros_like(mean), torch.zeros_like(squares)))
            sums[name] = before[0] + mean / len(samples), before[1] + squares / len(samples)
    return {
        name: InputMoments(mean.float(), (squares - torch.outer(mean, mean)).float())
        for name, (mean, squares) in sums.items()
    }


@torch.no_grad()
def round_products(backbone: RowProducts, layers: Collection[str], moments: dict[str, InputMoments]) -> None:
    """Round the weights of `layers` to what 8-bit arithmetic will use, in place."""
    for name in layers:
        product = backbone.product(name)
        rounded = round_together(product.weight, moments[name].squares)
        product.bias.add_((product.weight - rounded) @ moments[name].mean)
        product.weight.copy_(rounded)


def mixed_products(exact: Backbone, rounded: Backbone, eight_bit: Iterable[str]) -> Backbone:
    """Return a copy of `exact` with the rounded products of these names."""
    mixed = copy.deepcopy(exact)
    for name in eight_bit:
        mixed.products[name] = rounded.products[name]
    return mixed


def count_steps(product: nn.Linear, step: Tensor) -> None:
    """Let the outputs count steps (outputs,), STEP_VALUE for each."""
    product.weight.mul_(STEP_VALUE / step[:, None])
    product.bias.mul_(STEP_VALUE / step)
