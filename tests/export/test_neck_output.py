"""A graph that cannot hand out its neck's map."""

import onnx
import pytest

from asca_export.neck_output import add_neck_output
from asca_pillars.errors import ExportError


def test_refuses_a_graph_without_a_map() -> None:
    value = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.UINT8, [1, 2, 2, 4])
    other = onnx.helper.make_tensor_value_info("y", onnx.TensorProto.UINT8, [1, 2, 2, 8])
    nodes = [
        onnx.helper.make_node("Concat", ["x", "x"], ["joined"], axis=3),
        onnx.helper.make_node("Identity", ["joined"], ["y"]),
    ]
    for chosen in (nodes, [onnx.helper.make_node("Tile", ["x", "n"], ["y"])]):
        model = onnx.helper.make_model(onnx.helper.make_graph(chosen, "backbone", [value], [other]))
        with pytest.raises(ExportError, match="the backbone's graph joins"):
            add_neck_output(model)
