"""Edits of exported graphs: the head's input as an output; how the second stage reads and stores what it has."""

import numpy as np
import onnx
import onnxruntime
import pytest

from asca_export.two_stage.first_stage import add_neck_output, add_neck_steps
from asca_export.two_stage.graphs import halve_matrices, scale_bev


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


def test_large_matrices_are_stored_in_half_and_small_ones_as_they_are() -> None:
    rng = np.random.default_rng(0)
    matrices = {"large": rng.normal(size=(64, 80)), "small": rng.normal(size=(80, 8))}
    stored = [onnx.numpy_helper.from_array(value.astype(np.float32), name) for name, value in matrices.items()]
    x, y = (onnx.helper.make_tensor_value_info(*pair) for pair in (("x", 1, ["n", 64]), ("y", 1, ["n", 8])))
    nodes = [onnx.helper.make_node("MatMul", names, [to]) for *names, to in (("x", "large", "z"), ("z", "small", "y"))]
    graph = onnx.helper.make_graph(nodes, "refine", [x], [y], stored)
    refine = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 20)], ir_version=10)
    halved = halve_matrices(refine)
    assert len(halved.SerializeToString()) < 0.7 * len(refine.SerializeToString())
    values = rng.normal(size=(3, 64)).astype(np.float32)
    rounded = matrices["large"].astype(np.float16).astype(np.float32)
    expected = values @ rounded @ matrices["small"].astype(np.float32)
    np.testing.assert_allclose(run(halved, x=values), expected, rtol=1e-4, atol=1e-4)
    as_it_was = values @ matrices["large"].astype(np.float32) @ matrices["small"].astype(np.float32)
    np.testing.assert_allclose(run(refine, x=values), as_it_was, rtol=1e-4, atol=1e-4)
    assert np.abs(as_it_was - expected).max() > 1e-3, "the two can be told apart"
