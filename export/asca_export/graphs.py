"""Export of PyTorch modules to the ONNX graphs of a pillar bundle; the scatter between them is not exported."""

import dataclasses
import json
import logging
import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import onnx
import torch
from onnxscript import opset20 as op
from torch import Tensor, nn

from asca_deploy.bundle import PFN, Bundle
from asca_deploy.graph import Tensor as Declared
from asca_deploy.manifest import graph_files, graph_metadata
from asca_deploy.pillar.encoder import BIAS, PILLAR_MAXIMA, WEIGHT
from asca_deploy.pillar.graphs import PILLAR_FEATURES
from asca_export.fast_forms import FastBackbone, MaskedBackbone, PfnLayer
from asca_pillars.config.pillar import TRACED_PILLARS
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.ops.pillar.prepare import FEATURES

B = TypeVar("B", bound=Bundle)

OPSET = 20
_EXAMPLE_ROWS = 6  # rows of the traced example; dynamic in the graph
LOWEST = -3.0e38  # below any feature; every pillar holds a point, so it never survives the max
PIECES = 4
"""Parts of a scan's points that the PFN layer computes and reduces one after the other: each fits into the cache."""


def export_encoder(encode: nn.Module, path: Path) -> None:
    """Write an encoder.onnx that takes the points: features (M, 9), pillar_index (M,), point_counts (P,) -> (P, C).

    `encode` is a `PillarEncoder`, or has its interface. M and P are dynamic.
    """
    _export_point_graph(_Encoder(encode), path, [PILLAR_FEATURES])


def export_pfn(layer: PfnLayer, path: Path) -> None:
    """Write pfn.onnx: inputs as of `export_encoder` -> pillar_maxima (P, C), weight (9, C), bias (C,)."""
    _export_point_graph(layer, path, [PILLAR_MAXIMA, WEIGHT, BIAS])


def export_attention(attention: nn.Module, channels: int, path: Path) -> None:
    """Write the encoder.onnx that follows pfn.onnx: pillar_maxima (P, C) -> pillar_features (P, C).

    P is dynamic; the `paper` reading takes it up to the limit that it was trained with.
    """
    export_graph(
        _Attention(attention),
        (torch.rand(TRACED_PILLARS, channels),),
        path,
        input_names=[PILLAR_MAXIMA],
        output_names=[PILLAR_FEATURES],
        dynamic_shapes=({0: torch.export.Dim("pillars")},),
    )


def _export_point_graph(module: nn.Module, path: Path, output_names: Sequence[str]) -> None:
    points, pillars = 4 * TRACED_PILLARS, TRACED_PILLARS  # sizes of the traced example; dynamic in the graph
    point_counts = torch.full((pillars,), points // pillars)
    example = (
        torch.rand(points, len(FEATURES)),
        torch.arange(pillars).repeat_interleave(point_counts),
        point_counts,
    )
    rows, cells = torch.export.Dim("points"), torch.export.Dim("pillars")
    export_graph(
        module,
        example,
        path,
        input_names=["features", "pillar_index", "point_counts"],
        output_names=output_names,
        dynamic_shapes=({0: rows}, {0: rows}, {0: cells}),
    )


def export_row_graph(
    module: nn.Module,
    path: Path,
    inputs: Mapping[str, Declared],
    rows: Mapping[str, str],
    outputs: Iterable[str],
    multiples: Mapping[str, int] | None = None,
) -> None:
    """Write a graph whose inputs and outputs have a row of each of something, such as a keypoint; all are dynamic.

    Args:
        module: takes the inputs in their order.
        path: of the graph.
        inputs: what it declares.
        rows: what each input has rows of; one that is not named has a fixed number.
        outputs: their names.
        multiples: inputs that have several rows of each.
    """
    multiples = multiples or {}
    sizes = {name: torch.export.Dim(name) for name in dict.fromkeys(rows.values())}
    example, dynamic = [], []
    for name, (kind, shape) in inputs.items():
        multiple = multiples.get(name, 1)
        size = [_EXAMPLE_ROWS * multiple if extent is None else extent for extent in shape]
        example.append(torch.zeros(size, dtype=torch.int32) if kind == "int32" else torch.rand(size))
        dynamic.append({0: multiple * sizes[rows[name]]} if name in rows else {})
    names: dict[str, Any] = {"input_names": list(inputs), "output_names": list(outputs)}
    export_graph(module, example, path, dynamic_shapes=(tuple(dynamic),), **names)


def export_backbone(backbone: FastBackbone | MaskedBackbone, map_shape: tuple[int, int], path: Path) -> None:
    """Write backbone.onnx: canvas (1, H, W, C) -> scores, boxes, directions, see `FastBackbone`.

    H and W are the rows and columns of `map_shape` and the padding that the backbone takes.
    """
    channels = next(iter(backbone.stages()[0].convolutions.values())).in_channels
    rows, columns = (size + backbone.border for size in map_shape)
    export_graph(
        backbone,
        (torch.zeros(1, rows, columns, channels),),
        path,
        input_names=["canvas"],
        output_names=list(HeadMaps._fields),
    )


def multiply_accumulates(path: Path) -> int:
    """Return the multiply-accumulates of the convolutions and matrix products of a graph with fixed shapes."""
    graph = onnx.shape_inference.infer_shapes(onnx.load(path)).graph
    shapes = {
        value.name: [size.dim_value for size in value.type.tensor_type.shape.dim]
        for value in (*graph.input, *graph.value_info, *graph.output)
    } | {weights.name: list(weights.dims) for weights in graph.initializer}
    total = 0
    for node in graph.node:
        if node.op_type == "Conv":
            _, *window = shapes[node.input[1]]  # (outputs, inputs per group, height, width)
        elif node.op_type == "MatMul":
            window = shapes[node.input[1]][:1]
        else:
            continue
        total += math.prod(shapes[node.output[0]]) * math.prod(window)
    return total


def graph_path(folder: Path, name: str) -> Path:
    """Return the path of a graph in a bundle's folder."""
    return folder / f"{name}.onnx"


def sign(folder: Path, bundle: B) -> B:
    """Stamp the graphs in `folder` with what they must not be separated from; the bundle with their SHA-256."""
    properties = {key: json.dumps(value) for key, value in graph_metadata(bundle).items()}
    names = [name for name in dict.fromkeys((PFN, *bundle.graph_names)) if graph_path(folder, name).is_file()]
    for name in names:
        path = graph_path(folder, name)
        model = onnx.load(path)
        onnx.helper.set_model_props(model, properties)
        onnx.save(model, path)
    return dataclasses.replace(bundle, graphs=graph_files(folder, names))


def export_graph(module: nn.Module, example: Sequence[Tensor], path: Path, **names: Any) -> None:
    """Write a module as an ONNX file; `names` are those of `torch.onnx.export`."""
    with errors_only("torch.onnx"), errors_only("onnxscript"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's warnings about its own code
        program = torch.onnx.export(
            module.eval(),
            tuple(example),
            dynamo=True,
            opset_version=OPSET,
            custom_translation_table={
                torch.ops.asca.pillar_max.default: _scatter_max,
                torch.ops.asca.product_max.default: _product_max,
            },
            verbose=False,
            **names,
        )
    assert program is not None
    model = program.model_proto
    _forget_origin(model.graph)
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, path)


@contextmanager
def errors_only(name: str) -> Iterator[None]:
    """Log only errors of a library within the block; it would report every operator that it leaves unchanged."""
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


class _Attention(nn.Module):
    """One frame's attention, with the one input that the runtime feeds."""

    def __init__(self, attention: nn.Module) -> None:
        super().__init__()
        self.attention = attention

    def forward(self, pillar_maxima: Tensor) -> Tensor:
        attended: Tensor = self.attention(pillar_maxima)
        return attended


class _Encoder(nn.Module):
    """One frame's encoder, with the three inputs that the runtime feeds."""

    def __init__(self, encode: nn.Module) -> None:
        super().__init__()
        self.encode = encode

    def forward(self, features: Tensor, pillar_index: Tensor, point_counts: Tensor) -> Tensor:
        encoded: Tensor = self.encode(features, pillar_index, point_counts)
        return encoded


def _scatter_max(features: Any, pillar_index: Any, point_counts: Any) -> Any:
    """Translate `models.pillar.encoder.pillar_max` to ONNX: ScatterND with a max is the fastest form."""
    shape = op.Concat(op.Shape(point_counts), op.Shape(features, start=1), axis=0)
    lowest = op.Expand(op.Constant(value_float=LOWEST), shape)
    return op.ScatterND(lowest, op.Unsqueeze(pillar_index, _integer(1)), features, reduction="max")


def _product_max(features: Any, weight: Any, pillar_index: Any, point_counts: Any) -> Any:
    """Translate `fast_forms.product_max` to ONNX: PIECES of about as many points, cut between two pillars."""
    points, pillar, row, pieces = op.Shape(pillar_index), _integer(0), _integer(0), []
    for piece in range(1, PIECES + 1):
        place = op.Div(op.Mul(points, _integer(piece)), _integer(PIECES))
        last = op.Shape(point_counts) if piece == PIECES else op.Gather(pillar_index, place)
        counts = op.Slice(point_counts, pillar, last)
        end = op.Add(row, op.ReduceSum(counts, _integer(0)))
        index = op.Sub(op.Slice(pillar_index, row, end), pillar)
        pieces.append(_scatter_max(op.MatMul(op.Slice(features, row, end), weight), index, counts))
        pillar, row = last, end
    return op.Concat(*pieces, axis=0)


def _integer(value: int) -> Any:
    return op.Constant(value_ints=[value])


def _forget_origin(graph: Any) -> None:
    """Drop the stack traces that the exporter writes at every node, which name folders of the machine."""
    for part in (graph, *graph.node, *graph.value_info, *graph.input, *graph.output, *graph.initializer):
        del part.metadata_props[:]
