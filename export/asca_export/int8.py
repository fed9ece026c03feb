"""Quantization of a proven float bundle to 8 bits, with the differences measured before and after rounding."""

import copy
import hashlib
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar

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

from asca_deploy.bundle import BACKBONE, ENCODER, Bundle, CanvasFormat, LayerQuantization, PillarBundle, Quantization
from asca_deploy.detector import Detector
from asca_deploy.manifest import write_bundle_manifest
from asca_deploy.pillar.pipeline import Canvas, PillarPipeline, open_backbone
from asca_export import graphs
from asca_export.fast_forms import STEP_VALUE, CanvasSteps, FastBackbone
from asca_export.parity import COMPARED_ANCHORS, by_class
from asca_export.quantize import STEPS, canvas_steps, input_moments, layer_names, round_weights, scale_to_steps
from asca_export.sparse_forms import (
    SparseBackbone,
    SparseSample,
    export_sparse_backbone,
    mixed_products,
    read_moments,
    round_products,
    scale_rows_to_steps,
)
from asca_pillars.base.errors import ExportError
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.overlap import bev_iou
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.ops.pillar.grid import pool_pillars
from asca_pillars.ops.pillar.prepare import Pillars
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec


class EncodedScan(NamedTuple):
    """A scan on its way to the backbone."""

    features: NDArray[np.float32]
    """(P, C)"""
    pillars: Pillars

    def quantize_features(self, steps: CanvasSteps) -> NDArray[np.uint8]:
        """Return the features in whole steps, (P, C)."""
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
                canvas.scatter(*pool_pillars(scan.quantize_features(steps), scan.pillars.cells, detector.grid))
                for scan in encoded
            )

        return RoundedMaps(FastBackbone(detector, steps), canvases, steps, detector.grid.map_shape, work)
    return _RoundedSparse(detector, encoded, steps)


class RoundedMaps:
    """A dense backbone, see `RoundedBackbone`.

    Args:
        backbone: made with `steps`; changed in place.
        canvases: (1, H, W, C), of the calibration scans, each time anew.
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
        rounded = dict(self._rounded.named_parameters())
        return {
            name: rounded[name] if name.rpartition(".")[0] in eight_bit else parameter
            for name, parameter in self._exact.named_parameters()
        }


class _RoundedSparse:
    def __init__(self, detector: PillarDetector, encoded: Sequence[EncodedScan], steps: CanvasSteps) -> None:
        samples = [_sample(detector, scan).quantize_features(steps) for scan in encoded]
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
    # QuantizeLinear with a scale per channel says the same, and onnxruntime takes twenty times as long for it.
    per_unit, empty = 1 / steps.scale.numpy(), steps.empty.numpy()
    stored = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
    constants = {"one_step": np.array(1, np.float32), "first_step": np.array(0, np.uint8)}
    if last.op_type == "Gemm" and last.input[2] in stored:  # scale and offset cost nothing in its weight and bias
        constants |= {"steps_per_unit": per_unit[:, None], "steps_bias": stored[last.input[2]] * per_unit + empty}
        scaling = [helper.make_node("Mul", [last.input[1], "steps_per_unit"], ["steps_weight"], name="scale_weight")]
        graph.node.remove(last)
        last.input[1:] = ["steps_weight", "steps_bias"]
        last.output[0] = "shifted"
        scaling.append(last)
    else:
        last.output[0] = "float_features"
        constants |= {"steps_per_unit": per_unit, "empty": empty}
        scaling = [
            helper.make_node("Mul", ["float_features", "steps_per_unit"], ["scaled"], name="scale_features"),
            helper.make_node("Add", ["scaled", "empty"], ["shifted"], name="shift_features"),
        ]
    graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in constants.items())
    quantize = helper.make_node("QuantizeLinear", ["shifted", "one_step", "first_step"], [output.name], name="quantize")
    graph.node.extend([*scaling, quantize])
    output.type.tensor_type.elem_type = TensorProto.UINT8
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, path)


def quantize_backbone(template: Path, out: Path, layers: Collection[str], parameters: Mapping[str, Tensor]) -> None:
    """Write backbone.onnx with `layers` in 8 bits and its canvas in uint8.

    Args:
        template: `FastBackbone` in ONNX, its activations and canvas in steps.
        layers: some of `quantize.layer_names`.
        parameters: by name, of the module's shapes, such as (out, in, 3, 3); the weights of `layers` are
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


MIN_CALIBRATION = 8
# Error of the class logits of the best anchors. With the shipped bundle 0.04 costs 0.2 points of AP and 0.10 two;
# layers return to floating point, the most harmful first, until the error is below.
MAX_LOGIT_ERROR = 0.08
SAME_IOU = 0.5

Points = NDArray[np.float32]
B = TypeVar("B", bound=Bundle)


class Sensitivity(NamedTuple):
    """Result of the sensitivity sweep over the layers; errors are those of `logit_error`."""

    alone: dict[str, float]
    """Error with all layers in 8 bits but this one."""
    kept_float: list[str]
    total: float
    """Error with all layers in 8 bits but `kept_float`."""

    def report(self, calibration: "CalibrationScans", compared: int) -> Quantization:
        """Return the entry of the manifest; boxes are not counted yet."""
        return Quantization(
            calibration_scans=len(calibration.used),
            dropped_scans=calibration.dropped,
            compared_scans=compared,
            layers=tuple(LayerQuantization(name, error, name in self.kept_float) for name, error in self.alone.items()),
            logit_rms_error=self.total,
            boxes=0,
            boxes_matched=0,
            boxes_added=0,
        )


class CalibrationScans(NamedTuple):
    """Scans for calibration."""

    used: list[Points]
    dropped: int
    """Number of scans left out because parity is proven on them."""


def calibration_scans(
    calibration: Sequence[Points], scans: Sequence[Points], spec: PillarSpec | VoxelSpec
) -> CalibrationScans:
    """Return the scans (N, 4) of `calibration`, LiDAR frame, that have points on the grid and are not among `scans`.

    A comparison on a calibration scan would be on data that the ranges were fitted to.

    Raises:
        ExportError: fewer than MIN_CALIBRATION.
    """
    digests = {_digest(points) for points in scans}
    other_scans = [points for points in calibration if _digest(points) not in digests]
    dropped = len(calibration) - len(other_scans)
    used = [points for points in other_scans if (spec.grid.cells(points) >= 0).any()]
    if len(used) < MIN_CALIBRATION:
        raise ExportError(
            f"{len(used)} scans with points on the grid given to calibrate on, at least {MIN_CALIBRATION} are "
            f"needed; {dropped} were left out because parity is proven on them: give other scans to --calibrate"
        )
    return CalibrationScans(used, dropped)


def quantize_bundle(
    folder: Path,
    bundle: PillarBundle,
    detector: PillarDetector,
    calibration: Sequence[Points],
    scans: Sequence[Points],
    progress: Callable[[str], None] = lambda _: None,
) -> PillarBundle:
    """Replace the graphs and the manifest in `folder` by 8-bit ones.

    Args:
        folder: a proven float bundle.
        bundle: its manifest.
        detector: what it was exported from, in evaluation mode.
        calibration: scans (N, 4), LiDAR frame, that set the ranges, see `calibration_scans`.
        scans: to measure on.
        progress: called with a description of each step.

    Raises:
        ExportError: too few scans, or MAX_LOGIT_ERROR is exceeded whatever stays in floating point.
    """
    chosen_scans = calibration_scans(calibration, scans, bundle.spec)
    runtime = Detector(folder)
    pipeline = runtime.pipeline
    assert isinstance(pipeline, PillarPipeline), "the bundle has just been exported from a pillar detector"
    encoded = [_encode(pipeline, points) for points in chosen_scans.used]
    steps = canvas_steps(scan.features for scan in encoded)
    form = CanvasFormat("uint8", tuple(int(step) for step in steps.empty))
    eight_bit_form = replace(bundle, pillar=replace(bundle.pillar, canvas=form))
    compared = [_encode(pipeline, points) for points in scans]
    answers = (pipeline.backbone.run(pipeline.backbone.place(scan.features, scan.pillars.cells)) for scan in compared)
    expected = [answer.maps.scores for answer in answers]
    boxes = [runtime(points) for points in scans]
    with tempfile.TemporaryDirectory() as work:
        progress("Calibrating and rounding the weights")
        rounded, trial = round_backbone(detector, encoded, steps, Path(work)), Path(work) / "trial.onnx"

        def error_of(eight_bit: Sequence[str]) -> float:
            rounded.write(trial, eight_bit)
            backbone = open_backbone(trial, eight_bit_form, "cpu", "float32", runtime.threads)
            placed = (backbone.place(scan.quantize_features(steps), scan.pillars.cells) for scan in compared)
            actual = (backbone.run(inputs).maps.scores for inputs in placed)
            return logit_error(expected, actual, bundle.spec)

        sweep_result = sweep(rounded.layers, error_of, progress)
        eight_bit = [layer for layer in rounded.layers if layer not in sweep_result.kept_float]
        rounded.write(graphs.graph_path(folder, BACKBONE), eight_bit)
    quantize_encoder(graphs.graph_path(folder, ENCODER), steps)
    return write_quantized(folder, eight_bit_form, sweep_result.report(chosen_scans, len(scans)), boxes, scans)


def write_quantized(
    folder: Path, bundle: B, report: Quantization, expected: Sequence[Detections], scans: Sequence[Points]
) -> B:
    """Sign the 8-bit graphs in `folder` and write their manifest, with the boxes that they find again.

    Args:
        folder: with all graphs.
        bundle: the float bundle's manifest, in whatever the graphs have changed but precision and report.
        report: without boxes.
        expected: what the float bundle finds on the scans.
        scans: (N, 4) each, LiDAR frame, that both are compared on.
    """
    report = replace(report, boxes=sum(map(len, expected)))
    draft = replace(bundle, precision="int8", quantization=report)
    draft = graphs.sign(folder, draft)
    write_bundle_manifest(folder, draft)
    quantized = replace(draft, quantization=_with_boxes(report, expected, list(map(Detector(folder), scans))))
    write_bundle_manifest(folder, quantized)
    return quantized


def sweep(
    layers: Sequence[str], error_of: Callable[[Sequence[str]], float], progress: Callable[[str], None]
) -> Sensitivity:
    """Try every layer in floating point, and keep the most harmful ones so until the error is small enough.

    Args:
        layers: by name.
        error_of: the `logit_error` with these layers in 8 bits.
        progress: called with a description of each step.

    Raises:
        ExportError: MAX_LOGIT_ERROR is exceeded whatever stays in floating point.
    """
    total, alone = error_of(layers), {}
    for number, layer in enumerate(layers, start=1):
        progress(f"Sensitivity of layer {number} of {len(layers)}")
        alone[layer] = error_of([other for other in layers if other != layer])
    kept: list[str] = []
    for layer in sorted(layers, key=alone.__getitem__):
        if total <= MAX_LOGIT_ERROR:
            break
        kept.append(layer)
        total = error_of([other for other in layers if other not in kept])
    if total > MAX_LOGIT_ERROR:
        raise ExportError(
            f"an 8-bit canvas alone moves the class logits by {total:.3g}, more than {MAX_LOGIT_ERROR}; "
            "calibrate on scans like those trained on"
        )
    return Sensitivity(alone, kept, total)


def _with_boxes(report: Quantization, expected: Sequence[Detections], actual: Sequence[Detections]) -> Quantization:
    """Return the report with the boxes that the 8-bit bundle finds again, and those that it alone finds."""
    matched = sum(map(_count_matches, expected, actual))
    added = sum(map(len, actual)) - sum(map(_count_matches, actual, expected))
    return replace(report, boxes_matched=matched, boxes_added=added)


def _digest(points: Points) -> bytes:
    return hashlib.sha256(points.tobytes()).digest()


def _encode(pipeline: PillarPipeline, points: Points) -> EncodedScan:
    pillars = pipeline.pillarize(points)
    return EncodedScan(pipeline.encode(pillars), pillars)


def logit_error(
    expected: Sequence[NDArray[np.float32]], actual: Iterator[NDArray[np.float32]], spec: PillarSpec | VoxelSpec
) -> float:
    """Return the RMS difference of the class logits, at the COMPARED_ANCHORS best anchors of each class and scan."""
    squares = []
    for reference, got in zip(expected, actual, strict=True):
        for exact, rounded in zip(by_class(reference, spec), by_class(got, spec), strict=True):
            if len(exact):
                best = np.argpartition(-exact, min(COMPARED_ANCHORS, exact.size - 1))[:COMPARED_ANCHORS]
                squares.append(np.square(exact[best] - rounded[best]).mean())
    return float(np.sqrt(np.mean(squares)))


def _count_matches(boxes: Detections, others: Detections) -> int:
    """Return the number of boxes that match one of the others."""
    same = boxes.labels[:, None] == others.labels[None]
    return int(((bev_iou(boxes.boxes, others.boxes) >= SAME_IOU) & same).any(axis=1).sum())
