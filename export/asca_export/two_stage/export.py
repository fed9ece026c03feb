"""A checkpoint of the second stage becomes a bundle with both stages, or a clear refusal."""

import dataclasses
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray

from asca_deploy.bundle import BACKBONE, BUNDLE_FOLDER, ENCODER, REFINE, Parity, PillarBundle, RefineSection
from asca_deploy.detector import Detector
from asca_deploy.manifest import load_pillar_bundle
from asca_deploy.shipped import find_bundle
from asca_deploy.two_stage.pipeline import RefinePipeline
from asca_export import graphs
from asca_export.int8 import MAX_LOGIT_ERROR, calibration_scans, logit_error, write_quantized
from asca_export.pillar.export import draft_bundle, export_bundle, require_parity_scans, write_proven
from asca_export.two_stage.first_stage import BundleFirstStage, is_checkpoint, open_exported
from asca_export.two_stage.graphs import export_refine
from asca_export.two_stage.neck_output import add_neck_output, add_neck_steps, scale_bev
from asca_export.two_stage.parity import prove_refine_parity
from asca_pillars.base.errors import ExportError
from asca_pillars.base.files import atomic_directory
from asca_pillars.base.system import default_threads
from asca_pillars.config.tree import pillar_spec
from asca_pillars.models.checkpoint import Checkpoint, load_checkpoint
from asca_pillars.models.two_stage.first_stage import with_first_stage
from asca_pillars.models.two_stage.network import RefineDetector
from asca_pillars.ops.two_stage.first_stage import FirstStage


def export_refine_bundle(
    checkpoint: Checkpoint,
    out: str | Path,
    scans: Sequence[NDArray[np.float32]],
    *,
    trained_on: str = "not stated",
    command: str = "not stated",
    calibration: Sequence[NDArray[np.float32]] | None = None,
    weights: Path | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> PillarBundle:
    """Write the first stage's graphs, refine.onnx and bundle.json, and prove on `scans` that they are the checkpoint's.

    Arguments as of `pillar.export.export_bundle`. The first stage is the one that the checkpoint was trained on. With
    `calibration` it then gives way to its 8-bit form: of a bundle the one named like it with `_int8`, of a checkpoint
    one made on those scans. The second stage stays in float32.

    Raises:
        ExportError: too few scans, or PyTorch and onnxruntime differ; names the first stage that does. Or the 8-bit
            form is not that of this first stage.
        AscaError: the first stage is not there any more, or another one, or has no 8-bit form.
    """
    require_parity_scans(scans)
    config, detector = checkpoint.config, checkpoint.detector
    if not isinstance(detector, RefineDetector):
        raise ExportError(f"model.kind {config.model.kind}: not a second stage")
    stage = open_exported(detector.model.first_stage)
    model = with_first_stage(dataclasses.replace(detector.model, spec=pillar_spec(config)), stage)
    if calibration is not None:  # too few are told before the work, not after it
        calibration = calibration_scans(calibration, scans, model.spec).used
    with tempfile.TemporaryDirectory() as temporary, atomic_directory(out, *BUNDLE_FOLDER) as folder:
        first = _first_bundle(model.first_stage, Path(temporary) / "first", scans, progress)
        proposing = load_pillar_bundle(first)
        _copy_first_stage(first, proposing, folder)
        progress("Exporting the second stage and proving parity")
        path, classes = graphs.graph_path(folder, REFINE), len(model.spec.classes)
        section = RefineSection(model.bev_channels, model.refine.seen, model.refine.neighbors, model.refine.scores)
        export_refine(detector.refiner, section, classes, path)
        draft = draft_bundle(
            checkpoint._replace(config=dataclasses.replace(config, model=model)),
            scans,
            trained_on,
            command,
            pillar=proposing.pillar,
            backbone_gmac=proposing.backbone_gmac,
            refine=section,
        )

        def prove(signed: PillarBundle) -> Parity:
            pipeline = RefinePipeline(folder, signed, threads=default_threads())
            return prove_refine_parity(detector.refiner, stage, pipeline, model, scans)

        bundle = write_proven(folder, draft, prove, weights)
        if calibration is None:
            return bundle
        progress("Putting the first stage in 8 bits")
        eight_bit = _first_bundle(model.first_stage, Path(temporary) / "int8", scans, progress, calibration)
        return _in_eight_bits(folder, bundle, first, eight_bit, scans, calibration)


def _copy_first_stage(first: Path, proposing: PillarBundle, folder: Path) -> None:
    shutil.copyfile(first / proposing.graphs[ENCODER].file, graphs.graph_path(folder, ENCODER))
    onnx.save(add_neck_output(onnx.load(first / proposing.graphs[BACKBONE].file)), graphs.graph_path(folder, BACKBONE))


def _in_eight_bits(
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
    wanted, found = ([stage(scan).maps.scores for scan in scans] for stage in stages)
    error = logit_error(wanted, iter(found), proposing.spec)
    if error > MAX_LOGIT_ERROR:
        raise ExportError(
            f"{eight_bit}: its class logits are {error:.3g} from the first stage's, more than {MAX_LOGIT_ERROR}; it is "
            "not its 8-bit form: export that again"
        )
    expected = list(map(Detector(folder), scans))
    shutil.copyfile(eight_bit / proposing.graphs[ENCODER].file, graphs.graph_path(folder, ENCODER))
    backbone, step = add_neck_steps(onnx.load(eight_bit / proposing.graphs[BACKBONE].file))
    onnx.save(backbone, graphs.graph_path(folder, BACKBONE))
    refine = graphs.graph_path(folder, REFINE)
    onnx.save(scale_bev(onnx.load(refine), _neck_gains(*stages, calibration) * np.float32(step)), refine)
    report = dataclasses.replace(proposing.quantization, compared_scans=len(scans), logit_rms_error=error)
    return write_quantized(folder, dataclasses.replace(bundle, pillar=proposing.pillar), report, expected, scans)


def _neck_gains(
    floating: FirstStage, eight_bit: FirstStage, calibration: Sequence[NDArray[np.float32]]
) -> NDArray[np.float32]:
    """(C,) factors by which the 8-bit neck's channels come nearest to the float one's, by least squares."""
    products = squares = np.float64(0)
    for scan in calibration:
        wanted, found = (stage(scan).neck.astype(np.float64) for stage in (floating, eight_bit))
        axes = tuple(range(wanted.ndim - 1))
        products, squares = products + (wanted * found).sum(axes), squares + np.square(found).sum(axes)
    silent = squares == 0  # a channel that is zero everywhere
    return np.where(silent, 1, products / np.where(silent, 1, squares)).astype(np.float32)


def _first_bundle(
    source: str,
    temporary: Path,
    scans: Sequence[NDArray[np.float32]],
    progress: Callable[[str], None],
    calibration: Sequence[NDArray[np.float32]] | None = None,
) -> Path:
    """Folder of the first stage, with `calibration` in 8 bits; a checkpoint is exported to `temporary`."""
    if not is_checkpoint(source):
        return find_bundle(source if calibration is None else f"{source.rstrip('/')}_int8")
    export_bundle(load_checkpoint(source), temporary, scans, calibration=calibration, progress=progress)
    return temporary
