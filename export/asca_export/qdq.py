"""8-bit graphs in ONNX's QDQ form, written by onnxruntime.quantization."""

from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from onnxruntime.quantization import CalibrationMethod, QuantType
from onnxruntime.quantization.calibrate import TensorsData
from onnxruntime.quantization.qdq_quantizer import QDQQuantizer
from torch import Tensor

from asca_export import graphs
from asca_export.fast_forms import STEP_VALUE, CanvasSteps
from asca_export.quantize import STEPS

OP_TYPES = ["Conv", "MatMul", "Relu", "Transpose", "Reshape", "Concat"]


def quantize_encoder(path: Path, steps: CanvasSteps) -> None:
    """Make encoder.onnx give steps of the canvas, uint8, in place."""
    model = onnx.load(path)
    graph = model.graph
    (output,) = graph.output
    (last,) = (node for node in graph.node if output.name in node.output)
    last.output[0] = "float_features"
    constants = {
        "steps_per_unit": 1 / steps.scale.numpy(),
        "empty": steps.empty.numpy(),
        "one_step": np.array(1, np.float32),
        "first_step": np.array(0, np.uint8),
    }
    graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in constants.items())
    # QuantizeLinear with a scale per channel says the same, and onnxruntime takes twenty times as long for it.
    graph.node.extend(
        [
            helper.make_node("Mul", ["float_features", "steps_per_unit"], ["scaled"], name="scale_features"),
            helper.make_node("Add", ["scaled", "empty"], ["shifted"], name="shift_features"),
            helper.make_node("QuantizeLinear", ["shifted", "one_step", "first_step"], [output.name], name="quantize"),
        ]
    )
    output.type.tensor_type.elem_type = TensorProto.UINT8
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, path)


def quantize_backbone(template: Path, out: Path, layers: Collection[str], parameters: Mapping[str, Tensor]) -> None:
    """Write backbone.onnx with `layers` in 8 bits and its canvas in uint8.

    Args:
        template: `FastBackbone` in ONNX, its activations and canvas in steps.
        layers: some of `quantize.layer_names`.
        parameters: by name, unitless and of the module's shapes, such as (out, in, 3, 3); the weights of `layers` are
            rounded.
    """
    model = onnx.shape_inference.infer_shapes(onnx.load(template))
    for tensor in model.graph.initializer:
        if tensor.name in parameters:
            tensor.CopyFrom(numpy_helper.from_array(parameters[tensor.name].detach().numpy(), tensor.name))
    graph = model.graph
    floats = [node.name for node in graph.node if _layer(node) not in layers and node.op_type in ("Conv", "MatMul")]
    steps = (np.array(0, np.float32), np.array(STEPS * STEP_VALUE, np.float32))
    ranges = {value.name: steps for value in (*graph.input, *graph.value_info, *graph.output)}
    with graphs.errors_only(""):  # it gives advice on the root logger
        quantizer = QDQQuantizer(
            model,
            per_channel=True,
            reduce_range=True,
            weight_qType=QuantType.QInt8,
            activation_qType=QuantType.QUInt8,
            tensors_range=TensorsData(CalibrationMethod.MinMax, ranges),
            nodes_to_quantize=[],
            nodes_to_exclude=floats,
            op_types_to_quantize=OP_TYPES,
            extra_options={
                "OpTypesToExcludeOutputQuantization": ["MatMul"],  # the head's results stay floating point
                "QDQOpTypePerChannelSupportToAxis": {"MatMul": 1},
            },
        )
        quantizer.quantize_model()
    quantizer.model.topological_sort()
    quantized = quantizer.model.model
    _feed_uint8(quantized.graph)
    onnx.checker.check_model(quantized, full_check=True)
    onnx.save(quantized, out)


def _layer(node: onnx.NodeProto) -> str:
    return str(node.input[1]).removesuffix(".weight") if len(node.input) > 1 else ""


def _feed_uint8(graph: onnx.GraphProto) -> None:
    """Take the canvas as uint8. Runtimes know how to move the conversion through the transpose that follows."""
    (canvas,) = graph.input
    for node in graph.node:
        node.input[:] = ["float_canvas" if name == canvas.name else name for name in node.input]
    constants = {"step_value": np.array(STEP_VALUE, np.float32), "first_step": np.array(0, np.uint8)}
    graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in constants.items())
    graph.node.insert(0, helper.make_node("DequantizeLinear", [canvas.name, *constants], ["float_canvas"]))
    canvas.type.tensor_type.elem_type = TensorProto.UINT8
    del graph.value_info[:]
