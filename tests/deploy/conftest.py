"""A tiny bundle made without PyTorch: two small graphs with random weights behind a real bundle.json."""

import importlib.util
import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from asca_deploy.bundle import CanvasFormat, PillarBundle, PillarSection, Provenance
from asca_deploy.manifest import graph_files, graph_metadata, write_bundle_manifest
from asca_deploy.pillar.graphs import PILLAR_FEATURES
from asca_pillars.ops.pillar.grid import PillarGrid
from asca_pillars.ops.pillar.neck_rulebooks import MaskRule
from asca_pillars.ops.pillar.prepare import FEATURES, PillarLimits
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.scans.input_check import ExpectedInput

needs_openvino = pytest.mark.skipif(
    importlib.util.find_spec("openvino") is None, reason="needs pip install -e '.[openvino]'"
)

CHANNELS = 8
HEADS = (("scores", 1, -3.0, 0.5), ("boxes", 7, 0.0, 0.05), ("directions", 2, 0.0, 0.5))
"""Name, channels of an anchor, bias, spread of the weights."""
STAGES = ("pillarize", "encode", "scatter", "neck+head", "decode")
# 8 + 16 + 32 columns of 0.32, 0.16 and 0.08 m by 24 rows: rectangular, off center, with a positive minimum.
SPEC = PillarSpec(
    grid=PillarGrid(x_range_m=(2.0, 9.68), y_range_m=(-1.28, 2.56), z_range_m=(-3.0, 1.0)),
    limits=PillarLimits(max_pillars=300, max_points=8),
)
EXPECTED_INPUT = ExpectedInput(
    points_per_scan=(900, 1100), reflectance_mean=(0.2, 0.6), ground_z_m=(-1.9, -1.6), camera_view=False
)


def encoder_graph(uses_counts: bool) -> onnx.ModelProto:
    """max over a pillar's points of relu(W f + b), as ScatterND(max)."""
    rng = np.random.default_rng(1)
    weights: dict[str, NDArray[Any]] = {
        "weight": rng.normal(0, 0.5, (len(FEATURES), CHANNELS)).astype(np.float32),
        "bias": rng.normal(0, 0.1, CHANNELS).astype(np.float32),
        "channels": np.array([CHANNELS], np.int64),
        "last": np.array([-1], np.int64),
        "one": np.array([1], np.int64),
    }
    nodes = [
        helper.make_node("Gemm", ["features", "weight", "bias"], ["linear"]),
        helper.make_node("Relu", ["linear"], ["relu"]),
        helper.make_node("Unsqueeze", ["pillar_index", "last"], ["index"]),
    ]
    inputs = [_info("features", ["M", len(FEATURES)]), _info("pillar_index", ["M"], TensorProto.INT64)]
    if uses_counts:
        inputs.append(_info("point_counts", ["P"], TensorProto.INT64))
        nodes.append(helper.make_node("Shape", ["point_counts"], ["pillars"]))
    else:  # pillar_index is ascending, so its last value says how many pillars there are
        nodes += [
            helper.make_node("Gather", ["pillar_index", "last"], ["highest"]),
            helper.make_node("Add", ["highest", "one"], ["pillars"]),
        ]
    nodes += [
        helper.make_node("Concat", ["pillars", "channels"], ["shape"], axis=0),
        helper.make_node("ConstantOfShape", ["shape"], ["zeros"]),
        helper.make_node("ScatterND", ["zeros", "index", "relu"], ["pillar_features"], reduction="max"),
    ]
    return _model(nodes, inputs, [_info("pillar_features", ["P", CHANNELS])], weights)


def backbone_graph() -> onnx.ModelProto:
    """One strided convolution, then the three heads; maps and canvas channels last."""
    rng = np.random.default_rng(2)
    anchors = SPEC.anchors.shape[2]
    weights = {
        "neck.weight": rng.normal(0, 0.15, (16, CHANNELS, 3, 3)).astype(np.float32),
        "neck.bias": np.zeros(16, np.float32),
    }
    nodes = [
        helper.make_node("Transpose", ["canvas"], ["turned"], perm=[0, 3, 1, 2]),
        helper.make_node("Conv", ["turned", "neck.weight", "neck.bias"], ["neck"], strides=[2, 2]),
        helper.make_node("Relu", ["neck"], ["relu"]),
    ]
    outputs = []
    for name, per_anchor, bias, spread in HEADS:
        count = per_anchor * anchors
        weights[f"{name}.weight"] = rng.normal(0, spread, (count, 16, 1, 1)).astype(np.float32)
        weights[f"{name}.bias"] = np.full(count, bias, np.float32)
        nodes.append(helper.make_node("Conv", ["relu", f"{name}.weight", f"{name}.bias"], [f"{name}_first"]))
        nodes.append(helper.make_node("Transpose", [f"{name}_first"], [name], perm=[0, 2, 3, 1]))
        outputs.append(_info(name, [1, *SPEC.grid.head_shape, count]))
    canvas = _info("canvas", [1, SPEC.grid.ny + 1, SPEC.grid.nx + 1, CHANNELS])
    return _model(nodes, [canvas], outputs, weights)


def sparse_backbone_graph() -> onnx.ModelProto:
    """Strided convolutions of two levels, each upsampled to the head's cells; then the three heads."""
    rng = np.random.default_rng(2)
    anchors = SPEC.anchors.shape[2]
    weights: dict[str, NDArray[Any]] = {"one_row": np.array([0, 0, 1, 0])}  # of zeros, behind the last
    nodes, outputs = [], []
    rows, inputs = PILLAR_FEATURES, [_info(PILLAR_FEATURES, ["P", CHANNELS])]

    def product(name: str, given: str, channels: int, count: int, bias: float = 0.0, spread: float = 0.15) -> str:
        weights[f"{name}.weight"] = rng.normal(0, spread, (channels, count)).astype(np.float32)
        weights[f"{name}.bias"] = np.full(count, bias, np.float32)
        nodes.append(helper.make_node("Gemm", [given, f"{name}.weight", f"{name}.bias"], [name]))
        return name

    def gathered(rulebook: str, given: str, channels: int) -> str:
        weights[f"{rulebook}.shape"] = np.array([-1, channels], np.int64)
        nodes.append(helper.make_node("Pad", [given, "one_row"], [f"{rulebook}.padded"]))
        nodes.append(helper.make_node("Gather", [f"{rulebook}.padded", rulebook], [f"{rulebook}.rows"]))
        nodes.append(helper.make_node("Reshape", [f"{rulebook}.rows", f"{rulebook}.shape"], [f"{rulebook}.taps"]))
        return f"{rulebook}.taps"

    for level, children in enumerate((1, 4)):
        inputs.append(_info(f"strided_{level}", [f"M{level}", 9], TensorProto.INT32))
        inputs.append(_info(f"places_{level}", ["h"], TensorProto.INT32))
        block = product(f"block_{level}", gathered(f"strided_{level}", rows, 9 * CHANNELS), 9 * CHANNELS, CHANNELS)
        nodes.append(helper.make_node("Relu", [block], [f"relu_{level}"]))
        rows = f"relu_{level}"
        up = product(f"up_{level}", rows, CHANNELS, children * CHANNELS, spread=0.5)
        weights[f"up_{level}.shape"] = np.array([-1, CHANNELS], np.int64)
        nodes.append(helper.make_node("Reshape", [up, f"up_{level}.shape"], [f"children_{level}"]))
        gathered(f"places_{level}", f"children_{level}", CHANNELS)
    nodes.append(helper.make_node("Add", ["places_0.taps", "places_1.taps"], ["head"]))
    for name, count, bias, spread in HEADS:
        product(name, "head", CHANNELS, count * anchors, bias, spread)
        outputs.append(_info(name, ["h", count * anchors]))
    return _model(nodes, inputs, outputs, weights)


def write_bundle(
    folder: Path,
    uses_counts: bool = True,
    active_cells: MaskRule | None = None,
    spec: PillarSpec = SPEC,
    expected_input: ExpectedInput = EXPECTED_INPUT,
) -> Path:
    """A valid bundle in `folder`, with a rule of active cells one with a sparse neck, else with the grid of SPEC."""
    folder.mkdir(parents=True)
    onnx.save(encoder_graph(uses_counts), folder / "encoder.onnx")
    onnx.save(sparse_backbone_graph() if active_cells else backbone_graph(), folder / "backbone.onnx")
    provenance = Provenance(
        command="asca train tiny.yaml",
        created="2026-01-02",
        git_revision=None,
        trained_on="nothing, random weights",
        seed=1,
        steps=0,
        versions={"onnx": onnx.__version__},
        machine="test",
    )
    bundle = PillarBundle(
        name="tiny",
        kind="pillar",
        spec=spec,
        pillar=PillarSection("none", CHANNELS, CanvasFormat(), "sparse" if active_cells else "dense", active_cells),
        precision="float32",
        backbone_gmac=0.1,
        graphs={},
        parity=None,
        quantization=None,
        expected_input=expected_input,
        expected_input_from="training",
        provenance=provenance,
        license="Apache-2.0",
    )
    sign(folder, bundle)
    return folder


def sign(folder: Path, bundle: PillarBundle) -> None:
    """Stamp the graphs in `folder` with the essentials of `bundle`, and write it with their SHA-256."""
    for name in ("encoder.onnx", "backbone.onnx"):
        model = onnx.load(folder / name)
        helper.set_model_props(model, {key: json.dumps(value) for key, value in graph_metadata(bundle).items()})
        onnx.save(model, folder / name)
    write_bundle_manifest(folder, replace(bundle, graphs=graph_files(folder)))


@pytest.fixture(scope="session")
def tiny_bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good bundle that no test changes."""
    return write_bundle(tmp_path_factory.mktemp("bundles") / "tiny")


@pytest.fixture(scope="session")
def sparse_bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One with a sparse neck and the rule that no bundle has that ships; no test changes it."""
    return write_bundle(tmp_path_factory.mktemp("bundles") / "sparse", active_cells="sub")


@pytest.fixture(params=["dense", "sparse", "other direction bins"])
def any_bundle(request: pytest.FixtureRequest, tiny_bundle: Path, sparse_bundle: Path, tmp_path: Path) -> Path:
    """Bundles for implementations in other languages; no test changes them."""
    if request.param == "other direction bins":
        return write_bundle(tmp_path / "turned", spec=replace(SPEC, direction_offset_rad=-np.pi / 2))
    return sparse_bundle if request.param == "sparse" else tiny_bundle


@pytest.fixture
def bundle_copy(tiny_bundle: Path, tmp_path: Path) -> Path:
    """A good bundle for the test to spoil."""
    return Path(shutil.copytree(tiny_bundle, tmp_path / "tiny"))


def make_scan(seed: int = 0, count: int = 1000) -> NDArray[np.float32]:
    """A scan such as EXPECTED_INPUT describes: ground at -1.75 m, some things on it."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((2.0, -1.28, -1.8, 0.0), (9.68, 2.56, -1.7, 0.8), (count, 4))
    points[: count // 4, 2] += rng.uniform(0, 1.5, count // 4)
    return points.astype(np.float32)


@pytest.fixture
def scan() -> NDArray[np.float32]:
    return make_scan()


@pytest.fixture
def scans() -> list[NDArray[np.float32]]:
    """Three scans that fill different cells."""
    return [make_scan(seed, count) for seed, count in ((0, 1000), (1, 200), (2, 1000))]


@pytest.fixture
def bundle_without_counts(tmp_path: Path) -> Path:
    """The same model, exported without the input `point_counts`."""
    return write_bundle(tmp_path / "without_counts", uses_counts=False)


def _info(name: str, shape: list[int | str], kind: int = TensorProto.FLOAT) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, kind, shape)


def _model(
    nodes: list[onnx.NodeProto],
    inputs: list[onnx.ValueInfoProto],
    outputs: list[onnx.ValueInfoProto],
    weights: Mapping[str, NDArray[Any]],
) -> onnx.ModelProto:
    initializers = [numpy_helper.from_array(value, name) for name, value in weights.items()]
    graph = helper.make_graph(nodes, "tiny", inputs, outputs, initializers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.checker.check_model(model, full_check=True)
    return model
