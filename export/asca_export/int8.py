"""Quantization of a proven float bundle to 8 bits, with the differences measured."""

import hashlib
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from asca_deploy.bundle import BACKBONE, ENCODER, Bundle, CanvasFormat, LayerQuantization, PillarBundle, Quantization
from asca_deploy.detector import Detector
from asca_deploy.manifest import write_bundle_manifest
from asca_deploy.pillar.pipeline import PillarPipeline, open_backbone
from asca_export import graphs
from asca_export.parity import COMPARED_ANCHORS, by_class
from asca_export.quantize import canvas_steps
from asca_export.rounded_backbones import EncodedScan, quantize_encoder, round_backbone
from asca_pillars.base.errors import ExportError
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.overlap import bev_iou
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec

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

    def report(self, own: "CalibrationScans", compared: int) -> Quantization:
        """Return the entry of the manifest; boxes are not counted yet."""
        return Quantization(
            calibration_scans=len(own.used),
            dropped_scans=own.dropped,
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
    own = [points for points in calibration if _digest(points) not in digests]
    dropped = len(calibration) - len(own)
    used = [points for points in own if (spec.grid.cells(points) >= 0).any()]
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
    own = calibration_scans(calibration, scans, bundle.spec)
    runtime = Detector(folder)
    pipeline = runtime.pipeline
    assert isinstance(pipeline, PillarPipeline), "the bundle has just been exported from a pillar detector"
    encoded = [_encode(pipeline, points) for points in own.used]
    steps = canvas_steps(each.features for each in encoded)
    form = CanvasFormat("uint8", tuple(int(step) for step in steps.empty))
    eight_bit_form = replace(bundle, pillar=replace(bundle.pillar, canvas=form))
    compared = [_encode(pipeline, points) for points in scans]
    answers = (pipeline.backbone.run(pipeline.backbone.place(each.features, each.pillars.cells)) for each in compared)
    expected = [answer.maps.scores for answer in answers]
    boxes = [runtime(points) for points in scans]
    with tempfile.TemporaryDirectory() as work:
        progress("Calibrating and rounding the weights")
        rounded, trial = round_backbone(detector, encoded, steps, Path(work)), Path(work) / "trial.onnx"

        def error_of(eight_bit: Sequence[str]) -> float:
            rounded.write(trial, eight_bit)
            backbone = open_backbone(trial, eight_bit_form, "cpu", "float32", runtime.threads)
            placed = (backbone.place(each.quantize_features(steps), each.pillars.cells) for each in compared)
            found = (backbone.run(each).maps.scores for each in placed)
            return logit_error(expected, found, bundle.spec)

        found = sweep(rounded.layers, error_of, progress)
        eight_bit = [layer for layer in rounded.layers if layer not in found.kept_float]
        rounded.write(graphs.graph_path(folder, BACKBONE), eight_bit)
    quantize_encoder(graphs.graph_path(folder, ENCODER), steps)
    return write_quantized(folder, eight_bit_form, found.report(own, len(scans)), boxes, scans)


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


def _with_boxes(report: Quantization, expected: Sequence[Detections], found: Sequence[Detections]) -> Quantization:
    """Return the report with the boxes that the 8-bit bundle finds again, and those that it alone finds."""
    matched = sum(map(_count_matches, expected, found))
    added = sum(map(len, found)) - sum(map(_count_matches, found, expected))
    return replace(report, boxes_matched=matched, boxes_added=added)


def _digest(points: Points) -> bytes:
    return hashlib.sha256(points.tobytes()).digest()


def _encode(pipeline: PillarPipeline, points: Points) -> EncodedScan:
    pillars = pipeline.pillarize(points)
    return EncodedScan(pipeline.encode(pillars), pillars)


def logit_error(
    expected: Sequence[NDArray[np.float32]], found: Iterator[NDArray[np.float32]], spec: PillarSpec | VoxelSpec
) -> float:
    """Return the RMS difference of the class logits, at the COMPARED_ANCHORS best anchors of each class and scan."""
    squares = []
    for reference, got in zip(expected, found, strict=True):
        for ours, theirs in zip(by_class(reference, spec), by_class(got, spec), strict=True):
            if len(ours):
                best = np.argpartition(-ours, min(COMPARED_ANCHORS, ours.size - 1))[:COMPARED_ANCHORS]
                squares.append(np.square(ours[best] - theirs[best]).mean())
    return float(np.sqrt(np.mean(squares)))


def _count_matches(boxes: Detections, others: Detections) -> int:
    """Return the number of boxes that match one of the others."""
    same = boxes.labels[:, None] == others.labels[None]
    return int(((bev_iou(boxes.boxes, others.boxes) >= SAME_IOU) & same).any(axis=1).sum())
