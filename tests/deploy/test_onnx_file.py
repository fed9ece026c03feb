"""What is read of an ONNX file without the package onnx, against that package."""

from pathlib import Path

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from asca_deploy.onnx_file import has_external_data, read_metadata


def with_tensors(*tensors: onnx.TensorProto, within: onnx.TensorProto | None = None) -> onnx.ModelProto:
    """A model with these weights, and one more in a branch of an If."""
    branch = [helper.make_node("Constant", [], ["out"], value=within)] if within else []
    out = helper.make_tensor_value_info("out", TensorProto.FLOAT, [2])
    inner = helper.make_graph(branch, "branch", [], [out])
    choose = helper.make_node("If", ["yes"], ["out"], then_branch=inner, else_branch=inner)
    return helper.make_model(helper.make_graph([choose], "tiny", [], [out], list(tensors)))


def outside(tensor: onnx.TensorProto) -> onnx.TensorProto:
    """The tensor with its data in another file."""
    onnx.external_data_helper.set_external_data(tensor, "w.bin")
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    return tensor


def weight(name: str = "w") -> onnx.TensorProto:
    return numpy_helper.from_array(np.ones(2, np.float32), name)


@settings(max_examples=30)
@given(st.dictionaries(st.text(max_size=9), st.text(max_size=300), max_size=5))
def test_metadata(properties: dict[str, str]) -> None:
    model = with_tensors(weight())
    helper.set_model_props(model, properties)
    assert read_metadata(model.SerializeToString()) == properties


def test_external_data_wherever_it_is() -> None:
    assert not has_external_data(with_tensors(weight(), weight("v"), within=weight("u")).SerializeToString())
    assert has_external_data(with_tensors(weight(), outside(weight("v"))).SerializeToString())
    assert has_external_data(with_tensors(weight(), within=outside(weight("u"))).SerializeToString())


@given(st.binary(max_size=200))
def test_other_bytes_are_refused_or_read(data: bytes) -> None:
    for read in (read_metadata, has_external_data):
        try:
            read(data)
        except ValueError:
            continue


@pytest.mark.parametrize("name", ["encoder.onnx", "backbone.onnx"])
def test_a_file_that_ends_early(tiny_bundle: Path, name: str) -> None:
    content = (tiny_bundle / name).read_bytes()
    for end in range(1, len(content), 37):
        try:
            read_metadata(content[:end])
        except ValueError:
            continue
