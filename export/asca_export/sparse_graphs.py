"""`SparseBackbone` -> backbone.onnx: for each layer Concat (row of zeros), Gather, Reshape, Gemm, Relu.

The head reads the rows of all upsamplings by one more Gather.

In 8 bits all rows are uint8 from one Gemm to the next. Gemm stands between DequantizeLinear and QuantizeLinear, which
runtimes join into one integer operator; the quantization's zero point is the ReLU.
"""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from asca_deploy.pillar_graphs import PILLAR_FEATURES
from asca_export.fast_forms import STEP_VALUE
from asca_export.graphs import OPSET
from asca_export.quantize import WEIGHT_STEPS
from asca_export.sparse_forms import HEAD, SparseBackbone
from asca_pillars.geometry.decode import HeadMaps
from asca_pillars.tables.neck_tables import NeckTables, table_inputs

JOINED = f"{HEAD}.joined"
"""What the head's product reads, by name."""
_TINY = 1e-12


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
    graph = _Graph(backbone, frozenset(eight_bit), steps)
    model = helper.make_model(
        graph.build(), opset_imports=[helper.make_opsetid("", OPSET)], ir_version=10, producer_name="asca_export"
    )
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, path)


def multiply_accumulates(backbone: SparseBackbone, tables: NeckTables[NDArray[np.int32]]) -> int:
    """Count of multiply-accumulates of the products on the scan that these tables, indices (M, 9), are of."""
    inputs, total = table_inputs(tables), 0
    for level in backbone.levels:
        for layer in level.convolutions:
            rows = len(inputs[layer.table])
            total += rows * backbone.product(layer.name).weight.numel()
        total += rows * backbone.product(level.upsample).weight.numel()
    return total + len(tables.head_cells) * backbone.product(HEAD).weight.numel()


class _Graph:
    """Nodes and constants as they come."""

    def __init__(self, backbone: SparseBackbone, eight_bit: frozenset[str], steps: bool) -> None:
        self.backbone, self.eight_bit, self.steps = backbone, eight_bit, steps
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[str, NDArray[Any]] = {}
        self.inputs: dict[str, onnx.ValueInfoProto] = {}
        self.row_type = np.dtype(np.uint8 if steps else np.float32)

    def build(self) -> onnx.GraphProto:
        backbone, rows, maps = self.backbone, PILLAR_FEATURES, []
        element = helper.np_dtype_to_tensor_dtype(self.row_type)
        self.inputs[rows] = helper.make_tensor_value_info(rows, element, ["pillars", backbone.channels])
        missing = backbone.empty.numpy().astype(self.row_type)
        for level in backbone.levels:
            for layer in level.convolutions:
                taps = backbone.product(layer.name).in_features // len(missing)
                read = self._gather(layer.name, rows, missing, layer.table, taps)
                rows = self._product(layer.name, read)
                missing = np.zeros(backbone.product(layer.name).out_features, self.row_type)
            channels = backbone.product(level.upsample).out_features // level.stride**2
            maps.append(self._reshape(level.upsample, "pixels", self._product(level.upsample, rows), channels))
        places = [level.places for level in backbone.levels]
        outputs = self._product(HEAD, self._joined(maps, places, channels))
        sizes = self._constant(HEAD, "channels", np.array(backbone.head_channels, np.int64))
        self.nodes.append(
            helper.make_node("Split", [outputs, sizes], list(HeadMaps._fields), name="split_head", axis=1)
        )
        return helper.make_graph(
            self.nodes,
            "sparse_backbone",
            list(self.inputs.values()),
            [
                helper.make_tensor_value_info(name, TensorProto.FLOAT, ["head_cells", channels])
                for name, channels in zip(HeadMaps._fields, backbone.head_channels, strict=True)
            ],
            [numpy_helper.from_array(value, name) for name, value in self.constants.items()],
        )

    def _gather(self, owner: str, rows: str, missing: NDArray[Any], table: str, taps: int) -> str:
        """Rows by the table, the row `missing` behind the last: (M, taps * C)."""
        self.inputs[table] = helper.make_tensor_value_info(table, TensorProto.INT32, [f"{table}_rows", taps])
        padded = self._node("Concat", owner, "padded", rows, self._constant(owner, "missing", missing[None]), axis=0)
        gathered = self._node("Gather", owner, "gathered", padded, table, axis=0)
        return self._reshape(owner, "rows", gathered, taps * len(missing))

    def _joined(self, maps: Sequence[str], places: Sequence[str], channels: int) -> str:
        """Rows of several maps, picked by places (H,) of each, side by side: (H, maps * channels).

        By one gather from all maps, one after the other with a row of zeros behind each: with one from each of them,
        what they give would have to be copied once more, row by row, to stand side by side.
        """
        rows, indices, first = [], [], ""
        for number, (values, place) in enumerate(zip(maps, places, strict=True)):
            owner = f"head{number}"
            self.inputs[place] = helper.make_tensor_value_info(place, TensorProto.INT32, ["head_cells"])
            rows += [values, self._constant(owner, "missing", np.zeros((1, channels), self.row_type))]
            if number:
                size = self._node("Shape", owner, "size", maps[number - 1], start=0, end=1)
                count = self._node("Cast", owner, "count", size, to=TensorProto.INT32)
                after = self._node("Add", owner, "after", count, self._constant(owner, "one", np.array([1], np.int32)))
                first = self._node("Add", owner, "first", first, after) if first else after
            indices.append(self._node("Add", owner, "places", place, first) if first else place)
        by_map = self._reshape(HEAD, "by_map", self._node("Concat", HEAD, "places", *indices, axis=0), -1, len(maps))
        by_cell = self._node("Transpose", HEAD, "by_cell", by_map)  # (H, maps)
        gathered = self._node("Gather", HEAD, "gathered", self._node("Concat", HEAD, "maps", *rows, axis=0), by_cell)
        return self._reshape(HEAD, "joined", gathered, len(maps) * channels)

    def _reshape(self, owner: str, what: str, rows: str, width: int, count: int = -1) -> str:
        shape = self._constant(owner, f"{what}_shape", np.array([count, width]))
        return self._node("Reshape", owner, what, rows, shape)

    def _product(self, name: str, rows: str) -> str:
        """Gemm, and the ReLU unless it is the head's, whose results are always floating point."""
        product = self.backbone.product(name)
        weight, bias = product.weight.numpy(), product.bias.numpy()
        if self.steps:
            rows = self._dequantized(name, "input", rows, *self._step(name))
        if name in self.eight_bit:
            matrix, offset = self._rounded(name, weight, bias)
        else:
            matrix = self._constant(name, "weight", np.ascontiguousarray(weight.T))
            offset = self._constant(name, "bias", bias)
        results = self._node("Gemm", name, "product", rows, matrix, offset)
        if name == HEAD:
            return results
        results = self._node("Relu", name, "relu", results)
        return self._node("QuantizeLinear", name, "steps", results, *self._step(name)) if self.steps else results

    def _rounded(self, name: str, weight: NDArray[np.float32], bias: NDArray[np.float32]) -> tuple[str, str]:
        unit = np.maximum(np.abs(weight).max(axis=1) / WEIGHT_STEPS, _TINY).astype(np.float32)
        whole = np.round(weight / unit[:, None]).astype(np.int8)
        bias_unit = unit * np.float32(STEP_VALUE)
        limit = float(np.iinfo(np.int32).max // 2)
        whole_bias = np.clip(np.round(bias.astype(np.float64) / bias_unit), -limit, limit).astype(np.int32)
        weight_scale = self._constant(name, "weight_unit", unit), self._constant(name, "weight_zero", 0 * whole[:, 0])
        bias_scale = self._constant(name, "bias_unit", bias_unit), self._constant(name, "bias_zero", 0 * whole_bias)
        matrix = self._constant(name, "weight_steps", np.ascontiguousarray(whole.T))
        offset = self._constant(name, "bias_steps", whole_bias)
        return (
            self._dequantized(name, "weight", matrix, *weight_scale, axis=1),
            self._dequantized(name, "bias", offset, *bias_scale, axis=0),
        )

    def _step(self, owner: str) -> tuple[str, str]:
        step = self._constant(owner, "step", np.array(STEP_VALUE, np.float32))
        return step, self._constant(owner, "zero", np.array(0, np.uint8))

    def _dequantized(self, owner: str, what: str, value: str, *scale: str, **axis: int) -> str:
        return self._node("DequantizeLinear", owner, f"{what}_values", value, *scale, **axis)

    def _node(self, kind: str, owner: str, what: str, *inputs: str, **attributes: int) -> str:
        name = f"{owner}.{what}"
        self.nodes.append(helper.make_node(kind, list(inputs), [name], name=name, **attributes))
        return name

    def _constant(self, owner: str, what: str, value: NDArray[Any]) -> str:
        name = f"{owner}.{what}"
        self.constants[name] = value
        return name
