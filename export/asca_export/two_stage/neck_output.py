"""The neck's map as one more output of a backbone's graph: what a second stage reads of the first."""

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from asca_deploy.bundle import NECK
from asca_export.sparse_graphs import JOINED
from asca_pillars.base.errors import ExportError


def add_neck_output(backbone: onnx.ModelProto) -> onnx.ModelProto:
    """A copy of a backbone that also returns its head's input in float32, named NECK; the rest stays as it is.

    It is (1, H, W, C) of a dense neck, (M, C) at the active head cells of a sparse one. Channels of an 8-bit backbone
    are scaled so that all have steps of one size.

    Raises:
        ExportError: the graph has no such tensor.
    """
    model, values, is_float = _with_output(backbone, TensorProto.FLOAT)
    if not is_float:
        model.graph.node.append(_in_float(model, values))
        values = model.graph.node[-1].output[0]
    model.graph.node.append(helper.make_node("Identity", [values], [NECK], name="neck"))
    onnx.checker.check_model(model)
    return model


def add_neck_steps(backbone: onnx.ModelProto) -> tuple[onnx.ModelProto, float]:
    """As `add_neck_output` of an 8-bit backbone, but in uint8 steps, with the size of a step.

    That is a quarter of the memory, and nothing is computed for cells that no keypoint lies on. Where the head's input
    is in floating point, or step 0 is not zero, it is `add_neck_output`, of which a step is 1.

    Raises:
        ExportError: the graph has no such tensor.
    """
    model, values, is_float = _with_output(backbone, TensorProto.UINT8)
    if is_float:
        return add_neck_output(backbone), 1.0
    stored = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    step, zero = (stored[name] for name in _in_float(model, values).input[1:])
    if zero.any() or zero.dtype != np.uint8:
        return add_neck_output(backbone), 1.0
    model.graph.node.append(helper.make_node("Identity", [values], [NECK], name="neck"))
    onnx.checker.check_model(model)
    return model, float(step)


def scale_bev(refine: onnx.ModelProto, factors: NDArray[np.float32]) -> onnx.ModelProto:
    """A copy of the second stage's graph whose input `bev` is multiplied by `factors` (C,) first."""
    model = onnx.ModelProto()
    model.CopyFrom(refine)
    for node in model.graph.node:
        node.input[:] = ["bev.values" if name == "bev" else name for name in node.input]
    model.graph.initializer.append(numpy_helper.from_array(factors, "bev.factors"))
    model.graph.node.insert(0, helper.make_node("Mul", ["bev", "bev.factors"], ["bev.values"], name="bev.values"))
    onnx.checker.check_model(model)
    return model


def _with_output(backbone: onnx.ModelProto, elem_type: int) -> tuple[onnx.ModelProto, str, bool]:
    """A copy with a declared output NECK, the name of the head's input, and whether that is in floating point."""
    model = onnx.ModelProto()
    model.CopyFrom(backbone)
    joined = [node for node in _before_boxes(model) if node.op_type == "Concat" or node.output[0] == JOINED]
    types = {value.name: value.type.tensor_type for value in onnx.shape_inference.infer_shapes(model).graph.value_info}
    kind = types.get(joined[-1].output[0]) if joined else None
    if kind is None or not kind.shape.dim[-1].dim_value:
        raise ExportError("the backbone's graph joins no maps; export the first stage again")
    output = onnx.ValueInfoProto(name=NECK)
    output.type.tensor_type.CopyFrom(kind)
    output.type.tensor_type.elem_type = elem_type
    model.graph.output.append(output)
    return model, joined[-1].output[0], kind.elem_type == TensorProto.FLOAT


def _before_boxes(model: onnx.ModelProto) -> list[onnx.NodeProto]:
    """What the head's boxes are computed from, in order: masks of active cells are joined too, but for scores alone."""
    wanted = {value.name for value in model.graph.output if value.name != "scores"}
    found = []
    for node in reversed(model.graph.node):
        if wanted & set(node.output):
            wanted |= set(node.input)
            found.append(node)
    return found[::-1]


def _in_float(model: onnx.ModelProto, steps: str) -> onnx.NodeProto:
    """As the head's product reads the steps, in a node of its own: the other one is fused with that product."""
    for node in model.graph.node:
        if node.op_type == "DequantizeLinear" and node.input[0] == steps:
            return helper.make_node("DequantizeLinear", [steps, *node.input[1:]], ["neck.values"], name="neck.values")
    raise ExportError("the backbone's graph joins maps that are neither in float32 nor in 8 bits; export it again")
