"""First stage for the export of two stages: its backbone graph with the neck as an output, and the stage itself."""

import tempfile
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from asca_deploy.bundle import BACKBONE, NECK
from asca_deploy.manifest import load_pillar_bundle
from asca_deploy.pillar.pipeline import PillarPipeline, open_backbone
from asca_deploy.shipped import find_bundle
from asca_export.sparse_forms import JOINED
from asca_pillars.base.errors import ExportError
from asca_pillars.base.files import WEIGHTS_FILE
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.models.two_stage.first_stage import open_first_stage
from asca_pillars.ops.two_stage.first_stage import FirstStage, FirstStageOutputs, require_pillar_kind


def add_neck_output(backbone: onnx.ModelProto) -> onnx.ModelProto:
    """Return a copy of a backbone that also returns its head's input in float32, named NECK; the rest is unchanged.

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
    """Add the neck's output as `add_neck_output` does, but in uint8 steps; return the size of a step too.

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


def _with_output(backbone: onnx.ModelProto, elem_type: int) -> tuple[onnx.ModelProto, str, bool]:
    """Return a copy with a declared output NECK, the name of the head's input, and whether it is in floating point."""
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
    """Return the nodes that the head's boxes depend on, in order; masks of active cells only affect scores."""
    needed = {value.name for value in model.graph.output if value.name != "scores"}
    nodes = []
    for node in reversed(model.graph.node):
        if needed & set(node.output):
            needed |= set(node.input)
            nodes.append(node)
    return nodes[::-1]


def _in_float(model: onnx.ModelProto, steps: str) -> onnx.NodeProto:
    """Return a new node that dequantizes the steps as the head's product does: the existing one is fused with it."""
    for node in model.graph.node:
        if node.op_type == "DequantizeLinear" and node.input[0] == steps:
            return helper.make_node("DequantizeLinear", [steps, *node.input[1:]], ["neck.values"], name="neck.values")
    raise ExportError("the backbone's graph joins maps that are neither in float32 nor in 8 bits; export it again")


class BundleFirstStage:
    """A bundle in onnxruntime, see `ops.two_stage.first_stage.FirstStage`.

    Args:
        bundle: folder, or name of one that ships.
        threads: of onnxruntime.
        precision: that the bundle must have; the neck's channels of an 8-bit one are scaled, see `add_neck_output`.

    Raises:
        BundleError: the bundle is missing or damaged.
        ConfigError: it is of another kind.
        ExportError: it has another precision.
    """

    def __init__(
        self, bundle: str | Path, *, threads: int = 1, precision: Literal["float32", "int8"] = "float32"
    ) -> None:
        self._source = bundle, threads, precision
        folder = find_bundle(bundle)
        manifest = load_pillar_bundle(folder)
        require_pillar_kind(folder, manifest.kind)
        if manifest.precision != precision:
            raise ExportError(f"{folder}: a bundle in {manifest.precision}; give one in {precision}")
        self._pipeline = PillarPipeline(folder, manifest, threads=threads)
        model = add_neck_output(onnx.load(folder / manifest.graphs[BACKBONE].file))
        with tempfile.TemporaryDirectory() as temporary:
            path = Path(temporary) / manifest.graphs[BACKBONE].file
            onnx.save(model, path)
            channels = model.graph.output[-1].type.tensor_type.shape.dim[-1].dim_value
            self._backbone = open_backbone(path, manifest, "cpu", "float32", threads, channels)
        graphs = " ".join(graph.sha256 for graph in manifest.graphs.values())
        self.identity = manifest.provenance.weights_sha256 or graphs

    @property
    def spec(self) -> DetectorSpec:
        """Spec of the bundle."""
        return self._pipeline.spec

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as its source, from which the other process opens it: onnxruntime's sessions cannot be pickled."""
        bundle, threads, precision = self._source
        return partial(BundleFirstStage, threads=threads, precision=precision), (bundle,)

    def __call__(self, points: NDArray[np.float32]) -> FirstStageOutputs:
        """See `FirstStage`."""
        pillars = self._pipeline.pillarize(points)
        return self._backbone.infer_with_neck(self._backbone.place(self._pipeline.encode(pillars), pillars.cells))


def is_checkpoint(source: str) -> bool:
    """Return whether the first stage of that name is a checkpoint, and no bundle."""
    return Path(source).suffix == Path(WEIGHTS_FILE).suffix or Path(source).is_file()


def open_exported(source: str) -> FirstStage:
    """Open the exported form of the first stage that a second one was trained on; graphs suffice, without weights.

    Raises:
        AscaError: it is missing, damaged, of another family or not in float32.
    """
    return open_first_stage(source) if is_checkpoint(source) else BundleFirstStage(source)
