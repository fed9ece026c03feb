"""`SparseBackbone` -> backbone.onnx: for each layer Concat (row of zeros), Gather, Reshape, Gemm, Relu.

In 8 bits all rows are uint8 from one Gemm to the next. Gemm stands between DequantizeLinear and QuantizeLinear, which
runtimes join into one integer operator; the quantization's zero point is the ReLU.
"""

from collections.abc import Collection
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
        for number, level in enumerate(backbone.levels):
            for layer in level.convolutions:
                taps = backbone.product(layer.name).in_features // len(missing)
                read = self._gather(layer.name, rows, missing, layer.table, taps)
                rows = self._product(layer.name, read)
                missing = np.zeros(backbone.product(layer.name).out_features, self.row_type)
            channels = backbone.product(level.upsample).out_features // level.stride**2
            upsampled = self._reshape(level.upsample, self._product(level.upsample, rows), channels)
            nothing = np.zeros(channels, self.row_type)
            maps.append(self._gather(f"head{number}", upsampled, nothing, level.places, 0))
        joined = self._node("Concat", HEAD, "joined", *maps, axis=1)
        outputs = self._product(HEAD, joined)
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
        """Rows by the table, the row `missing` behind the last: (M, taps * C); by places (M,) where taps is 0."""
        shape: list[str | int] = [f"{table}_rows", taps] if taps else ["head_cells"]
        self.inputs[table] = helper.make_tensor_value_info(table, TensorProto.INT32, shape)
        padded = self._node("Concat", owner, "padded", rows, self._constant(owner, "missing", missing[None]), axis=0)
        gathered = self._node("Gather", owner, "gathered", padded, table, axis=0)
        return self._reshape(owner, gathered, taps * len(missing)) if taps else gathered

    def _reshape(self, owner: str, rows: str, width: int) -> str:
        return self._node("Reshape", owner, "rows", rows, self._constant(owner, "shape", np.array([-1, width])))

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
