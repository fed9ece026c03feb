"""Convolutions by table in ONNX: for each layer Concat (row of zeros), Gather, Reshape, Gemm, Relu.

In 8 bits all rows are uint8 from one Gemm to the next. Gemm stands between DequantizeLinear and QuantizeLinear, which
runtimes join into one integer operator; the quantization's zero point is the ReLU.
"""

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from asca_export.fast_forms import STEP_VALUE
from asca_export.graphs import OPSET
from asca_export.quantize import WEIGHT_STEPS

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

    def gather(self, owner: str, rows: str, missing: NDArray[Any], table: str, taps: int) -> str:
        """Gather unitless rows by the table (M, taps), the row `missing` (C,) behind the last: (M, taps * C)."""
        self.add_input(table, TensorProto.INT32, f"{table}_rows", taps)
        padded = self.node("Concat", owner, "padded", rows, self.constant(owner, "missing", missing[None]), axis=0)
        gathered = self.node("Gather", owner, "gathered", padded, table, axis=0)
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
        """Add a unitless initializer (any shape)."""
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
