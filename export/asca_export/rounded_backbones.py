"""A backbone before and after its weights are rounded to 8 bits, and graphs in which any of its layers is rounded."""

import copy
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from onnxruntime.quantization import CalibrationMethod, QuantType
from onnxruntime.quantization.calibrate import TensorsData
from onnxruntime.quantization.qdq_quantizer import QDQQuantizer
from torch import Tensor
from torch.utils._pytree import tree_map_only

from asca_deploy.bundle import CanvasFormat
from asca_deploy.pillar.pipeline import Canvas
from asca_export import graphs
from asca_export.fast_forms import STEP_VALUE, CanvasSteps, FastBackbone
from asca_export.quantize import STEPS, input_moments, layer_names, round_weights, scale_to_steps
from asca_export.sparse_forms import SparseBackbone, export_sparse_backbone
from asca_export.sparse_quantize import (
    SparseSample,
    mixed_products,
    read_moments,
    round_products,
    scale_rows_to_steps,
)
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.ops.pillar.grid import pool_pillars
from asca_pillars.ops.pillar.prepare import Pillars


class EncodedScan(NamedTuple):
    """A scan on its way to the backbone."""

    features: NDArray[np.float32]
    """(P, C)"""
    pillars: Pillars

    def quantize_features(self, steps: CanvasSteps) -> NDArray[np.uint8]:
        """Return the features in whole steps, (P, C), unitless."""
        scale, empty = steps.scale.numpy(), steps.empty.numpy()
        return np.clip(np.round(self.features / scale + empty), 0, STEPS).astype(np.uint8)


class RoundedBackbone(Protocol):
    """A backbone whose layers can each be rounded or not."""

    @property
    def layers(self) -> Sequence[str]:
        """Names, in the order in which they compute."""

    def write(self, path: Path, eight_bit: Sequence[str]) -> None:
        """Write the graph with these layers in 8 bits, the others in floating point, and all rows in steps."""


def round_backbone(
    detector: PillarDetector, encoded: Sequence[EncodedScan], steps: CanvasSteps, work: Path
) -> RoundedBackbone:
    """Round the weights of a dense or of a sparse neck and its head.

    Args:
        detector: in evaluation mode; not modified.
        encoded: the calibration scans.
        steps: of their pillar features.
        work: folder for what is needed on the way.
    """
    if detector.preparation.active_cells is None:
        form, channels = CanvasFormat("uint8", tuple(int(step) for step in steps.empty)), len(steps.empty)

        def canvases() -> Iterator[NDArray[np.uint8]]:
            canvas = Canvas(channels, detector.grid, form)
            return (
                canvas.scatter(*pool_pillars(each.quantize_features(steps), each.pillars.cells, detector.grid))
                for each in encoded
            )

        return RoundedMaps(FastBackbone(detector, steps), canvases, steps, detector.grid.map_shape, work)
    return _RoundedSparse(detector, encoded, steps)


class RoundedMaps:
    """A dense backbone, see `RoundedBackbone`.

    Args:
        backbone: made with `steps`; changed in place.
        canvases: (1, H, W, C), unitless, of the calibration scans, each time anew.
        steps: of the canvases.
        map_shape: rows and columns of the map.
        work: folder for what is needed on the way.
    """

    def __init__(
        self,
        backbone: FastBackbone,
        canvases: Callable[[], Iterable[NDArray[np.uint8]]],
        steps: CanvasSteps,
        map_shape: tuple[int, int],
        work: Path,
    ) -> None:
        self._rounded = backbone.eval()
        scale_to_steps(self._rounded, canvases(), steps)
        moments = input_moments(self._rounded, canvases(), steps)
        self._exact, self.layers = copy.deepcopy(self._rounded), layer_names(self._rounded)
        round_weights(self._exact, [], moments)
        round_weights(self._rounded, self.layers, moments)
        self._template = work / "template.onnx"
        graphs.export_backbone(self._exact, map_shape, self._template)

    def write(self, path: Path, eight_bit: Sequence[str]) -> None:
        """Write the graph with these layers in 8 bits."""
        quantize_backbone(self._template, path, eight_bit, self._parameters(eight_bit))

    def _parameters(self, eight_bit: Sequence[str]) -> dict[str, Tensor]:
        """Return the parameters by name: rounded ones of the layers in 8 bits, exact ones of the others."""
        own = dict(self._rounded.named_parameters())
        return {
            name: own[name] if name.rpartition(".")[0] in eight_bit else parameter
            for name, parameter in self._exact.named_parameters()
        }


class _RoundedSparse:
    def __init__(self, detector: PillarDetector, encoded: Sequence[EncodedScan], steps: CanvasSteps) -> None:
        samples = [_sample(detector, each).quantize_features(steps) for each in encoded]
        self._exact = SparseBackbone(detector, steps)
        scale_rows_to_steps(self._exact, samples)
        self._rounded, self.layers = copy.deepcopy(self._exact), list(self._exact.products)
        round_products(self._rounded, self.layers, read_moments(self._exact, samples))

    def write(self, path: Path, eight_bit: Sequence[str]) -> None:
        mixed = mixed_products(self._exact, self._rounded, eight_bit)
        export_sparse_backbone(mixed, path, eight_bit, steps=True)


def _sample(detector: PillarDetector, encoded: EncodedScan) -> SparseSample:
    rulebooks = detector.preparation.place(encoded.pillars).rulebooks
    assert rulebooks is not None
    features, _ = pool_pillars(encoded.features, encoded.pillars.cells, detector.grid)
    return SparseSample(torch.from_numpy(features), tree_map_only(np.ndarray, torch.from_numpy, rulebooks))


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
    """Declare the canvas input as uint8. Runtimes can move the conversion through the transpose that follows."""
    (canvas,) = graph.input
    for node in graph.node:
        node.input[:] = ["float_canvas" if name == canvas.name else name for name in node.input]
    constants = {"step_value": np.array(STEP_VALUE, np.float32), "first_step": np.array(0, np.uint8)}
    graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in constants.items())
    graph.node.insert(0, helper.make_node("DequantizeLinear", [canvas.name, *constants], ["float_canvas"]))
    canvas.type.tensor_type.elem_type = TensorProto.UINT8
    del graph.value_info[:]
