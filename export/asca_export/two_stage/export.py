"""Export of the second stage's checkpoint to a bundle with both stages.

Parity with the trained model is proven graph by graph on the same inputs, then of the boxes.
"""

import dataclasses
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray

from asca_deploy.bundle import BACKBONE, BUNDLE_FOLDER, ENCODER, PFN, REFINE, Parity, PillarBundle, RefineSection
from asca_deploy.detector import Detector
from asca_deploy.manifest import load_pillar_bundle
from asca_deploy.shipped import find_bundle
from asca_deploy.two_stage.pipeline import RefinePipeline, refine_inputs
from asca_export import graphs
from asca_export.bundle_writer import DEFAULTS, ExportOptions, draft_bundle, require_parity_scans, write_bundle
from asca_export.int8 import MAX_LOGIT_ERROR, calibration_scans, logit_error, write_quantized
from asca_export.parity import MAP_TOLERANCE, require_close, require_compared, require_same_refined
from asca_export.pillar.export import export_pillar_bundle
from asca_export.two_stage.first_stage import (
    BundleFirstStage,
    add_neck_output,
    add_neck_steps,
    is_checkpoint,
    open_exported,
)
from asca_export.two_stage.graphs import export_refine, halve_matrices, scale_bev
from asca_pillars.base.errors import ExportError
from asca_pillars.base.files import atomic_directory
from asca_pillars.base.system import default_threads
from asca_pillars.config.tree import pillar_spec
from asca_pillars.config.two_stage import RefineModel
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.models.build import Checkpoint, load_checkpoint
from asca_pillars.models.two_stage.first_stage import with_first_stage
from asca_pillars.models.two_stage.layers import PillarRefiner
from asca_pillars.models.two_stage.network import RefineDetector
from asca_pillars.models.two_stage.preparation import collate_scans
from asca_pillars.ops.two_stage.first_stage import FirstStage, second_stage_inputs
from asca_pillars.ops.two_stage.prepare import refine_scan


def check_refine_parity(
    refiner: PillarRefiner,
    stage: FirstStage,
    runtime: RefinePipeline,
    model: RefineModel,
    scans: Sequence[NDArray[np.float32]],
) -> Parity:
    """Compare the first stage as it was trained on and the second in PyTorch with the exported graphs.

    The second stage's graph and its boxes are compared on the same proposals, because a proposal that one side has
    and the other lacks, by a tie between scores, would hide what the graph does.

    Args:
        refiner: in evaluation mode.
        stage: the first stage that it was trained on.
        runtime: opened on the bundle.
        scans: (N, 4) each.

    Raises:
        ExportError: they differ; names the first stage that does, and the scan. Or no scan has a point in the ranges.
    """
    worst = worst_box = worst_yaw = 0.0
    compared = 0
    for number, scan in enumerate(scans):
        points = scan[np.isfinite(scan).all(axis=1)]
        expected, outputs = stage(points), runtime.infer(runtime.prepare(points, []), []).outputs
        for name, in_torch_part, in_runtime_part in zip(HeadMaps._fields, expected.maps, outputs.maps, strict=True):
            worst = max(worst, require_close(f"head `{name}`", in_torch_part, in_runtime_part, MAP_TOLERANCE, number))
        allowed = MAP_TOLERANCE * max(1.0, float(np.abs(expected.neck).max(initial=0.0)))
        worst = max(worst, require_close("neck", expected.neck, outputs.neck, allowed, number))
        proposed = second_stage_inputs(outputs, points, model.spec, model.refine.seen)
        if not len(proposed.proposals):
            continue
        compared += 1
        asked = refine_scan(points, proposed, proposed.proposals, model.refine.neighbors)
        with torch.inference_mode():
            refinements = refiner(collate_scans([asked]))
        in_torch = refinements.confidence.numpy(), refinements.residuals.numpy()
        in_runtime = runtime.refine(refine_inputs(asked))
        for name, in_torch_part, in_runtime_part in zip(("confidence", "residuals"), in_torch, in_runtime, strict=True):
            worst = max(worst, require_close(f"refine `{name}`", in_torch_part, in_runtime_part, MAP_TOLERANCE, number))
        scores = model.refine.scores
        difference = require_same_refined(proposed.proposals, in_torch, in_runtime, model.spec, scores, number)
        worst_box, worst_yaw = max(worst_box, difference.center_size_m), max(worst_yaw, difference.yaw_rad)
    return Parity(worst, worst_box, worst_yaw, require_compared(compared), MAP_TOLERANCE)


def export_refine_bundle(
    checkpoint: Checkpoint,
    out: str | Path,
    scans: Sequence[NDArray[np.float32]],
    options: ExportOptions = DEFAULTS,
) -> PillarBundle:
    """Export kind pillar_refine, see `export.export_bundle`: the first stage's graphs and refine.onnx.

    The first stage is the one that the checkpoint was trained on. With `options.calibration` it then gives way to its
    8-bit form: of a bundle the one named like it with `_int8`, of a checkpoint one made on those scans. The second
    stage still computes in float32, from matrices stored in 16 bits.

    Expected input is the first stage's, if that knows its training scans: it reads the whole scan, and the second stage
    only what lies around its boxes. So two stages look around in one pass if the first one was trained on revolutions.

    Raises:
        ExportError: as `export_bundle`, or the 8-bit form is not that of this first stage.
        AscaError: the first stage is not there any more, or another one, or has no 8-bit form.
    """
    config, detector = checkpoint.config, checkpoint.detector
    assert isinstance(detector, RefineDetector), "it is of kind pillar_refine"
    require_parity_scans(scans)
    stage = open_exported(detector.model.first_stage)
    model = with_first_stage(dataclasses.replace(detector.model, spec=pillar_spec(config)), stage)
    calibration = options.calibration
    if calibration is not None:  # too few are told before the work, not after it
        calibration = calibration_scans(calibration, scans, model.spec).used
    with tempfile.TemporaryDirectory() as temporary, atomic_directory(out, *BUNDLE_FOLDER) as folder:
        in_float = ExportOptions(progress=options.progress)
        first = _first_bundle(model.first_stage, Path(temporary) / "first", scans, in_float)
        proposing = load_pillar_bundle(first)
        _copy_first_stage(first, proposing, folder)
        options.progress("Exporting the second stage and proving parity")
        section = RefineSection(model.bev_channels, model.refine.seen, model.refine.neighbors, model.refine.scores)
        export_refine(detector.refiner, section, len(model.spec.classes), graphs.graph_path(folder, REFINE))
        draft = draft_bundle(
            PillarBundle,
            model.spec,
            checkpoint,
            scans,
            options,
            kind="pillar_refine",
            pillar=proposing.pillar,
            backbone_gmac=proposing.backbone_gmac,
            refine=section,
        )
        if proposing.expected_input_from == "training":
            draft = dataclasses.replace(draft, expected_input=proposing.expected_input, expected_input_from="training")

        def compare(opened: PillarBundle) -> Parity:
            pipeline = RefinePipeline(folder, opened, threads=default_threads())
            return check_refine_parity(detector.refiner, stage, pipeline, model, scans)

        bundle = write_bundle(folder, draft, compare, options.weights)
        if calibration is None:
            return bundle
        options.progress("Quantizing the first stage")
        quantized = dataclasses.replace(in_float, calibration=calibration)
        eight_bit = _first_bundle(model.first_stage, Path(temporary) / "int8", scans, quantized)
        return _to_int8(folder, bundle, first, eight_bit, scans, calibration)


def _copy_first_stage(first: Path, proposing: PillarBundle, folder: Path) -> None:
    _copy_encoder(first, proposing, folder)
    onnx.save(add_neck_output(onnx.load(first / proposing.graphs[BACKBONE].file)), graphs.graph_path(folder, BACKBONE))


def _copy_encoder(first: Path, proposing: PillarBundle, folder: Path) -> None:
    graphs.graph_path(folder, PFN).unlink(missing_ok=True)  # of a form of the first stage that has it
    for name in {PFN, ENCODER} & set(proposing.graphs):
        shutil.copyfile(first / proposing.graphs[name].file, graphs.graph_path(folder, name))


def _to_int8(
    folder: Path,
    bundle: PillarBundle,
    first: Path,
    eight_bit: Path,
    scans: Sequence[NDArray[np.float32]],
    calibration: Sequence[NDArray[np.float32]],
) -> PillarBundle:
    """Replace the first stage's graphs in `folder` by those of `eight_bit`, and compare the refined boxes."""
    proposing = load_pillar_bundle(eight_bit)
    alike = proposing.spec.grid == bundle.spec.grid and proposing.pillar.neck == bundle.pillar.neck
    if proposing.quantization is None or not alike:
        raise ExportError(f"{eight_bit}: not the 8-bit form of the first stage; export it again")
    threads = default_threads()
    stages = BundleFirstStage(first, threads=threads), BundleFirstStage(eight_bit, threads=threads, precision="int8")
    reference, actual = ([stage(scan).maps.scores for scan in scans] for stage in stages)
    error = logit_error(reference, iter(actual), proposing.spec)
    if error > MAX_LOGIT_ERROR:
        raise ExportError(
            f"{eight_bit}: its class logits are {error:.3g} from the first stage's, more than {MAX_LOGIT_ERROR}; it is "
            "not its 8-bit form: export that again"
        )
    expected = list(map(Detector(folder), scans))
    _copy_encoder(eight_bit, proposing, folder)
    backbone, step = add_neck_steps(onnx.load(eight_bit / proposing.graphs[BACKBONE].file))
    onnx.save(backbone, graphs.graph_path(folder, BACKBONE))
    refine = graphs.graph_path(folder, REFINE)
    scaled = scale_bev(onnx.load(refine), _neck_gains(*stages, calibration) * np.float32(step))
    onnx.save(halve_matrices(scaled), refine)
    report = dataclasses.replace(proposing.quantization, compared_scans=len(scans), logit_rms_error=error)
    return write_quantized(folder, dataclasses.replace(bundle, pillar=proposing.pillar), report, expected, scans)


def _neck_gains(
    floating: FirstStage, eight_bit: FirstStage, calibration: Sequence[NDArray[np.float32]]
) -> NDArray[np.float32]:
    """Return (C,) factors by which the 8-bit neck's channels come nearest to the float one's, by least squares."""
    products = squares = np.float64(0)
    for scan in calibration:
        reference, actual = (stage(scan).neck.astype(np.float64) for stage in (floating, eight_bit))
        axes = tuple(range(reference.ndim - 1))
        products, squares = products + (reference * actual).sum(axes), squares + np.square(actual).sum(axes)
    silent = squares == 0  # a channel that is zero everywhere
    return np.where(silent, 1, products / np.where(silent, 1, squares)).astype(np.float32)


def _first_bundle(source: str, temporary: Path, scans: Sequence[NDArray[np.float32]], options: ExportOptions) -> Path:
    """Return the first stage's folder, with `options.calibration` in 8 bits; `temporary` is for exports."""
    if not is_checkpoint(source):
        return find_bundle(source if options.calibration is None else _in_eight_bits(source.rstrip("/")))
    export_pillar_bundle(load_checkpoint(source), temporary, scans, options)
    return temporary


def _in_eight_bits(bundle: str) -> str:
    """Return the name of a float32 bundle's 8-bit form: default of default_float32, mine_int8 of mine."""
    stem = bundle.removesuffix("_float32")
    return f"{bundle}_int8" if stem == bundle else stem
