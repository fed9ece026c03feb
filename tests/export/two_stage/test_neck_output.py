"""The head's input as an output, in float32 and in steps."""

import numpy as np
import onnx
import onnxruntime
import pytest

from asca_export.two_stage.first_stage import add_neck_output, add_neck_steps, scale_bev


def run(model: onnx.ModelProto, **inputs: np.ndarray) -> np.ndarray:
    """The last output."""
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return np.asarray(session.run(None, inputs)[-1])


@pytest.mark.parametrize("zero", [0, 3])
def test_steps_are_the_map_before_it_is_scaled(zero: int) -> None:
    value = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.UINT8, [5, 4])
    other = onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [5, 8])
    nodes = [
        onnx.helper.make_node("Concat", ["x", "x"], ["joined"], axis=1),
        onnx.helper.make_node("DequantizeLinear", ["joined", "step", "zero"], ["y"]),
    ]
    scalars = [np.array(0.25, np.float32), np.array(zero, np.uint8)]
    stored = [onnx.numpy_helper.from_array(*pair) for pair in zip(scalars, ("step", "zero"), strict=True)]
    graph = onnx.helper.make_graph(nodes, "backbone", [value], [other], stored)
    backbone = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 20)], ir_version=10)
    x = np.random.default_rng(0).integers(0, 256, (5, 4)).astype(np.uint8)
    expected = run(add_neck_output(backbone), x=x)
    assert (expected == (np.tile(x, 2).astype(np.float32) - zero) / 4).all()
    model, step = add_neck_steps(backbone)
    found = run(model, x=x)
    assert found.dtype == (np.float32 if zero else np.uint8), "steps of which 0 is not zero have no use"
    assert (found * np.float32(step) == expected).all()


def test_the_second_stage_scales_what_it_reads() -> None:
    bev, found = (onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["k", 3]) for name in ("bev", "y"))
    graph = onnx.helper.make_graph([onnx.helper.make_node("Neg", ["bev"], ["y"])], "refine", [bev], [found])
    refine = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 20)], ir_version=10)
    scaled = scale_bev(refine, np.array([1, 2, 0.5], np.float32))
    assert run(scaled, bev=np.full((2, 3), 4, np.float32)).tolist() == [[-4, -8, -2]] * 2
    assert run(refine, bev=np.ones((1, 3), np.float32)).tolist() == [[-1] * 3], "the other one stays as it is"
