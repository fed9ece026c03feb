"""The real OpenVINO against the real onnxruntime."""

import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper

from asca_deploy import Detections, Detector, auto, openvino_session, sample_scan_path
from asca_deploy.graph import Session, Tensor
from asca_deploy.openvino_session import OpenVinoSession
from asca_deploy.ort_session import OrtSession
from asca_pillars.base.errors import BundleError, ProviderError
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.scans.scan_reader import read_scan
from tests.deploy.conftest import needs_openvino
from tests.helpers.bundles import DENSE_FLOAT32, DENSE_INT8

pytestmark = needs_openvino

Open = Callable[[Path], Session]
BACKENDS: dict[str, Open] = {
    "onnxruntime": lambda path: OrtSession(path, "cpu", "float32", threads=2),
    "openvino": lambda path: OpenVinoSession(path, "float32", threads=2),
}
by_backend = pytest.mark.parametrize("backend", BACKENDS)


def maps_and_boxes(
    precision: str | None, bundle: Path = DENSE_FLOAT32
) -> tuple[HeadMaps[NDArray[np.float32]], Detections, Detector]:
    """Run a bundle on the sample scan, in OpenVINO with this precision or, with None, in onnxruntime."""
    where = {} if precision is None else {"provider": "openvino", "precision": precision}
    detector = Detector(bundle, **where)  # type: ignore[arg-type]
    pipeline = detector.pipeline
    answer = pipeline.infer(pipeline.prepare(read_scan(sample_scan_path()).points, []), [])
    return answer.maps, pipeline.finish(answer, []), detector


def test_float32_is_what_the_stock_cpu_computes() -> None:
    (expected, boxes, _), (found, same_boxes, _) = maps_and_boxes(None), maps_and_boxes("float32")
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-3)
    assert len(boxes) > 3 and same_boxes.names == boxes.names
    np.testing.assert_allclose(same_boxes.boxes, boxes.boxes, atol=1e-3)


def test_8_bits_are_the_same_8_bits() -> None:
    """Sums of 8-bit products are exact; only which way a tie between two steps falls may differ."""
    expected, boxes, detector = maps_and_boxes(None, DENSE_INT8)
    found, same_boxes, _ = maps_and_boxes("float32", DENSE_INT8)
    assert auto.disagreement(boxes, same_boxes, detector.spec) is None
    for ours, theirs in zip(found, expected, strict=True):
        assert np.sqrt(np.square(ours - theirs).mean()) < 0.005 * theirs.std()


def test_reduced_finds_the_same_boxes() -> None:
    try:
        openvino_session.require("reduced")
    except ProviderError as error:
        pytest.skip(str(error))
    (expected, boxes, detector), (found, same_boxes, _) = maps_and_boxes(None), maps_and_boxes("reduced")
    assert auto.disagreement(boxes, same_boxes, detector.spec) is None
    for ours, theirs in zip(found, expected, strict=True):
        difference, largest = np.abs(ours - theirs), np.abs(theirs).max()
        assert difference.max() > 1e-3, "computed in float32"
        # OpenVINO rounds the biases too, and where there is no point their errors add up; no box comes from there.
        assert np.median(difference) < 0.02 * largest and difference.max() < 0.25 * largest


@pytest.fixture
def graph(tmp_path: Path) -> Path:
    """double(2, 3) and sum(1,) of an image (2, 3) of bytes."""
    nodes = [
        helper.make_node("Cast", ["image"], ["float"], to=TensorProto.FLOAT),
        helper.make_node("Add", ["float", "float"], ["double"]),
        helper.make_node("ReduceSum", ["float"], ["sum"], keepdims=0),
    ]
    outputs = [
        helper.make_tensor_value_info("double", TensorProto.FLOAT, [2, 3]),
        helper.make_tensor_value_info("sum", TensorProto.FLOAT, []),
    ]
    inputs = [helper.make_tensor_value_info("image", TensorProto.UINT8, [2, 3])]
    model = helper.make_model(
        helper.make_graph(nodes, "bytes", inputs, outputs), opset_imports=[helper.make_opsetid("", 18)], ir_version=10
    )
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, tmp_path / "bytes.onnx")
    return tmp_path / "bytes.onnx"


@by_backend
def test_bytes_in_and_outputs_by_name(graph: Path, backend: str) -> None:
    session = BACKENDS[backend](graph)
    assert session.inputs == {"image": Tensor("uint8", (2, 3))}
    assert session.outputs == {"double": Tensor("float32", (2, 3)), "sum": Tensor("float32", ())}
    image = np.arange(6, dtype=np.uint8).reshape(2, 3) + 200
    total, double = session.run(["sum", "double"], {"image": image})
    np.testing.assert_array_equal(double, 2.0 * image)
    assert total == image.sum() and double.dtype == np.float32
    np.testing.assert_array_equal(session.run(["double"], {"image": image[::-1, ::-1]})[0], 2.0 * image[::-1, ::-1])


@by_backend
def test_results_outlive_the_next_run_whichever_thread_asks(graph: Path, backend: str) -> None:
    session = BACKENDS[backend](graph)
    images = [np.full((2, 3), value, np.uint8) for value in range(100)]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda image: session.run(["double"], {"image": image})[0], images))
    for image, double in zip(images, found, strict=True):
        np.testing.assert_array_equal(double, 2.0 * image)


@pytest.mark.parametrize("threads", [1, 2])
def test_threads_are_as_told(graph: Path, threads: int) -> None:
    model = OpenVinoSession(graph, "float32", threads)._request.get_compiled_model()
    assert model.get_property("INFERENCE_NUM_THREADS") == threads
    assert model.get_property("NUM_STREAMS") == 1
    assert model.get_property("ENABLE_CPU_PINNING") is False


def test_a_graph_without_a_fixed_shape(graph: Path) -> None:
    model = onnx.load(graph)
    for value in (model.graph.input[0], model.graph.output[0]):
        value.type.tensor_type.shape.dim[0].dim_param = "N"
    onnx.save(model, graph)
    with pytest.raises(BundleError, match=r"bytes\.onnx: its outputs have no fixed shapes.*choose provider cpu"):
        OpenVinoSession(graph, "float32", threads=1)


def test_a_file_that_is_no_graph(tmp_path: Path) -> None:
    (tmp_path / "backbone.onnx").write_bytes(b"not protobuf")
    with pytest.raises(BundleError, match=r"OpenVINO \d+\.\d.* cannot run .*backbone\.onnx") as caught:
        OpenVinoSession(tmp_path / "backbone.onnx", "float32", threads=1)
    assert "\n" not in str(caught.value)


IMPORTS = """
import sys
from asca_deploy import Detector
Detector(sys.argv[1])
assert "openvino" not in sys.modules
Detector(sys.argv[1], provider="openvino")
assert "openvino" in sys.modules and "openvino_telemetry" not in sys.modules
"""


def test_it_is_imported_when_it_is_used_and_reports_to_nobody(tiny_bundle: Path) -> None:
    result = subprocess.run([sys.executable, "-W", "error", "-c", IMPORTS, str(tiny_bundle)], capture_output=True)
    assert result.returncode == 0, result.stderr.decode()
