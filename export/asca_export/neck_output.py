"""The neck's map as one more output of a backbone's graph: what a second stage reads of the first."""

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from asca_deploy.bundle import NECK
from asca_export.sparse_graphs import JOINED
from asca_pillars.errors import ExportError


def add_neck_output(backbone: onnx.ModelProto, gains: NDArray[np.float32] | None = None) -> onnx.ModelProto:
    """A copy of a backbone that also returns its head's input in float32, named NECK; the rest stays as it is.

    It is (1, H, W, C) of a dense neck, (M, C) at the active head cells of a sparse one.

    Args:
        backbone: in floating point, or in 8 bits.
        gains: (C,) factors of its channels: those of an 8-bit backbone are scaled so that all have steps of one size,
            and this brings them back. None leaves them as they are.

    Raises:
        ExportError: the graph has no such tensor.
    """
    model = onnx.ModelProto()
    model.CopyFrom(backbone)
    joined = [node for node in model.graph.node if node.op_type == "Concat" or node.output[0] == JOINED]
    types = {value.name: value.type.tensor_type for value in onnx.shape_inference.infer_shapes(model).graph.value_info}
    kind = types.get(joined[-1].output[0]) if joined else None
    if kind is None or not kind.shape.dim[-1].dim_value:
        raise ExportError("the backbone's graph joins no maps; export the first stage again")
    output = onnx.ValueInfoProto(name=NECK)
    output.type.tensor_type.CopyFrom(kind)
    output.type.tensor_type.elem_type = TensorProto.FLOAT
    model.graph.output.append(output)
    values = joined[-1].output[0]
    if kind.elem_type != TensorProto.FLOAT:
        model.graph.node.append(_in_float(model, values))
        values = model.graph.node[-1].output[0]
    gains = np.ones(kind.shape.dim[-1].dim_value, np.float32) if gains is None else gains
    model.graph.initializer.append(numpy_helper.from_array(gains, "neck.gains"))
    model.graph.node.append(helper.make_node("Mul", [values, "neck.gains"], [NECK], name="neck"))
    onnx.checker.check_model(model)
    return model


def _in_float(model: onnx.ModelProto, steps: str) -> onnx.NodeProto:
    """As the head's product reads the steps, in a node of its own: the other one is fused with that product."""
    for node in model.graph.node:
        if node.op_type == "DequantizeLinear" and node.input[0] == steps:
            return helper.make_node("DequantizeLinear", [steps, *node.input[1:]], ["neck.values"], name="neck.values")
    raise ExportError("the backbone's graph joins maps that are neither in float32 nor in 8 bits; export it again")
