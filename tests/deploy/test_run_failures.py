"""A graph that opens and fails while it runs: one line with bundle and graph, wherever it is run from."""

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper

from asca_deploy import Detector
from asca_deploy.providers import open_session
from asca_pillars.base.errors import BundleError, ProviderError
from asca_pillars.scans.scan_reader import write_scan
from tests.deploy import conftest as tiny
from tests.deploy.conftest import needs_openvino
from tests.deploy.corrupt_graph import corrupt_graph
from tests.helpers.in_process import run_here


def add_first(model: onnx.ModelProto, name: str, nodes: list[onnx.NodeProto], **constants: float) -> None:
    """Nodes that make `added`, which is added to the input of this name before all else."""
    for constant, value in constants.items():
        kind = np.int64 if isinstance(value, int) else np.float32
        model.graph.initializer.append(numpy_helper.from_array(np.array([value], kind), constant))
    for node in model.graph.node:
        node.input[:] = ["changed" if given == name else given for given in node.input]
    following = [*nodes, helper.make_node("Add", [name, "added"], ["changed"]), *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(following)


def read_beyond_the_end(model: onnx.ModelProto) -> None:
    """The encoder asks for a point far behind the last one."""
    add_first(model, "features", [helper.make_node("Gather", ["features", "far"], ["added"])], far=10**6)


def take_all_memory(model: onnx.ModelProto) -> None:
    """The backbone makes an array of 40 TB, whose size no optimizer can know."""
    nodes = [
        helper.make_node("ReduceMax", ["canvas"], ["largest"], keepdims=0),
        helper.make_node("Mul", ["largest", "nothing"], ["zero"]),
        helper.make_node("Add", ["zero", "much"], ["size"]),
        helper.make_node("Cast", ["size"], ["shape"], to=onnx.TensorProto.INT64),
        helper.make_node("ConstantOfShape", ["shape"], ["huge"]),
        helper.make_node("ReduceMax", ["huge"], ["added"], keepdims=0),
    ]
    add_first(model, "canvas", nodes, nothing=0.0, much=1e13)


FAILURES = pytest.mark.parametrize(
    ("graph", "spoil", "message"),
    [
        ("encoder.onnx", read_beyond_the_end, "upgrade with `pip install --upgrade onnxruntime`, or export the bundle"),
        ("backbone.onnx", take_all_memory, "give it more memory, or fewer points at once"),
    ],
)


@FAILURES
def test_of_a_detector_it_is_one_line(bundle_copy: Path, graph: str, spoil: object, message: str) -> None:
    detector = Detector(corrupt_graph(bundle_copy, graph, spoil))  # type: ignore[arg-type]
    scan = tiny.make_scan()
    for detect in (detector, lambda points: list(detector.stream([points, points]))):
        with pytest.raises(BundleError, match=rf"onnxruntime \S+ failed while it ran .*{graph}: .*{message}") as caught:
            detect(scan)
        assert str(bundle_copy) in str(caught.value)
        assert str(caught.value).isprintable() and len(str(caught.value)) < 900


@FAILURES
def test_of_a_command_it_is_one_line(
    bundle_copy: Path, tmp_path: Path, graph: str, spoil: object, message: str
) -> None:
    bundle = corrupt_graph(bundle_copy, graph, spoil)  # type: ignore[arg-type]
    scan, scans = tmp_path / "scan.bin", tmp_path / "scans"
    write_scan(scan, tiny.make_scan())
    for number in range(2):
        write_scan(scans / f"{number}.bin", tiny.make_scan(number))
    for arguments in (
        ("detect", scan, "-b", bundle, "--out", tmp_path / "one"),
        ("detect", scans, "-b", bundle, "--out", tmp_path / "many"),
        ("bench", scans, "-b", bundle),
        ("export", bundle, "--golden", "-o", tmp_path / "golden", "--scans", scan),
    ):
        done = run_here(*arguments)
        assert done.returncode > 1 and done.stderr.startswith("asca: "), done.stderr
        assert done.stderr.count("\n") == 1 and graph in done.stderr and str(bundle) in done.stderr
        assert not (tmp_path / "golden").exists()


def test_of_a_device_it_names_the_processor(tiny_bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session = open_session(tiny_bundle / "backbone.onnx", "cpu", "float32", threads=1)

    def fail(*_: object) -> None:
        raise RuntimeError("CUDA failure 2: out of memory\nand 20 lines more")

    monkeypatch.setattr(session, "_provider", "cuda")
    monkeypatch.setattr(session, "_session", type("Failing", (), {"run": staticmethod(fail)}))
    with pytest.raises(
        ProviderError, match=r"backbone\.onnx: CUDA failure 2: out of memory; give .*; provider cpu may"
    ):
        session.run(("scores",), {})


@needs_openvino
def test_of_openvino_it_is_one_line(tiny_bundle: Path) -> None:
    session = open_session(tiny_bundle / "backbone.onnx", "openvino", "float32", threads=1)
    with pytest.raises(ProviderError, match=r"OpenVINO \S+ failed while it ran .*backbone\.onnx: .*; provider cpu may"):
        session.run(("scores",), {"canvas": np.zeros((1, 3, 3, tiny.CHANNELS), np.float32)})
