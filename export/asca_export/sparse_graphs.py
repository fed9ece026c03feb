"""`SparseBackbone` -> backbone.onnx, see `row_graphs`; the head reads all upsamplings' rows by one more Gather."""

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto, helper

from asca_deploy.pillar.graphs import PILLAR_FEATURES
from asca_export.quantize import HEAD
from asca_export.row_graphs import RowGraph
from asca_export.sparse_forms import SparseBackbone
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.ops.pillar.neck_rulebooks import NeckTables, table_inputs

JOINED = f"{HEAD}.joined"
"""What the head's product reads, by name."""


def export_sparse_backbone(
    backbone: SparseBackbone, path: Path, eight_bit: Collection[str] = (), *, steps: bool = False
) -> None:
    """Write the graph: pillar features (P, C) and the int32 tables -> scores, boxes, directions of each head cell.

    Args:
        backbone: made with canvas steps and scaled to steps, if `steps`.
        path: of the file.
        eight_bit: products that compute in 8 bits, their weights already rounded; others in float.
        steps: rows are uint8 steps rather than float32.
    """
    graph, maps = RowGraph(backbone.product, eight_bit), []
    row_type = np.dtype(np.uint8 if steps else np.float32)
    rows = graph.take(PILLAR_FEATURES, helper.np_dtype_to_tensor_dtype(row_type), "pillars", backbone.channels)
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
        graph.give(name, TensorProto.FLOAT, "head_cells", channels)
    graph.save(path, "sparse_backbone")


def sparse_multiply_accumulates(backbone: SparseBackbone, tables: NeckTables[NDArray[np.int32]]) -> int:
    """Count of multiply-accumulates of the products on the scan that these tables, indices (M, 9), are of."""
    inputs, total = table_inputs(tables), 0
    for level in backbone.levels:
        for layer in level.convolutions:
            rows = len(inputs[layer.table])
            total += rows * backbone.product(layer.name).weight.numel()
        total += rows * backbone.product(level.upsample).weight.numel()
    return total + len(tables.head_cells) * backbone.product(HEAD).weight.numel()


def _joined(graph: RowGraph, maps: Sequence[str], places: Sequence[str], missing: NDArray[np.generic]) -> str:
    """Rows of several maps, picked by places (H,) of each, side by side: (H, maps * channels).

    By one gather from all maps, one after the other with the row `missing` (1, channels) behind each: with one from
    each of them, what they give would have to be copied once more, row by row, to stand side by side.
    """
    rows, indices, first = [], [], ""
    for number, (values, place) in enumerate(zip(maps, places, strict=True)):
        owner = f"head{number}"
        graph.take(place, TensorProto.INT32, "head_cells")
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
