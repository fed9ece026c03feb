"""The neck's map as one more output of a backbone's graph: what a second stage reads of the first."""

import onnx
from onnx import TensorProto, helper

from asca_deploy.bundle import NECK
from asca_pillars.errors import ExportError


def add_neck_output(backbone: onnx.ModelProto) -> onnx.ModelProto:
    """A copy of a float backbone that also returns its head's input, named NECK; the rest stays as it is.

    It is (1, H, W, C) of a dense neck, (M, C) at the active head cells of a sparse one.

    Raises:
        ExportError: the graph has no such tensor in floating point.
    """
    model = onnx.ModelProto()
    model.CopyFrom(backbone)
    joined = [node for node in model.graph.node if node.op_type == "Concat"]
    types = {value.name: value.type.tensor_type for value in onnx.shape_inference.infer_shapes(model).graph.value_info}
    kind = types.get(joined[-1].output[0]) if joined else None
    if kind is None or kind.elem_type != TensorProto.FLOAT or not kind.shape.dim[-1].dim_value:
        raise ExportError("the backbone's graph joins no maps in floating point; give a bundle in float32")
    model.graph.node.append(helper.make_node("Identity", [joined[-1].output[0]], [NECK]))
    output = onnx.ValueInfoProto(name=NECK)
    output.type.tensor_type.CopyFrom(kind)
    model.graph.output.append(output)
    onnx.checker.check_model(model)
    return model
