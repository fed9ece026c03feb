"""A checkpoint of the second stage becomes a bundle with both stages, or a clear refusal."""

import dataclasses
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray

from asca_deploy.bundle import BACKBONE, ENCODER, MANIFEST, REFINE, Bundle, Parity, RefineSection
from asca_deploy.manifest import load_bundle
from asca_deploy.refine_pipeline import RefinePipeline
from asca_deploy.shipped import find_bundle
from asca_export import graphs
from asca_export.exporter import MIN_SCANS, draft_bundle, export_bundle, write_proven
from asca_export.neck_output import add_neck_output
from asca_export.refine_graph import export_refine
from asca_export.refine_parity import prove_refine_parity
from asca_pillars.config import pillar_spec
from asca_pillars.errors import ExportError
from asca_pillars.files import atomic_directory
from asca_pillars.models.checkpoint import Checkpoint, load_checkpoint
from asca_pillars.models.refine.refine_detector import RefineDetector
from asca_pillars.models.second_stage.open_first_stage import CHECKPOINT_SUFFIX, open_first_stage, with_first_stage
from asca_pillars.system import default_threads


def export_refine_bundle(
    checkpoint: Checkpoint,
    out: str | Path,
    scans: Sequence[NDArray[np.float32]],
    *,
    trained_on: str = "not stated",
    command: str = "not stated",
    progress: Callable[[str], None] = lambda _: None,
) -> Bundle:
    """Write the first stage's graphs, refine.onnx and bundle.json, and prove on `scans` that they are the checkpoint's.

    Arguments as of `exporter.export_bundle`. The first stage is the one that the checkpoint was trained on.

    Raises:
        ExportError: too few scans, or PyTorch and onnxruntime differ; names the first stage that does.
        AscaError: the first stage is not there any more, or another one.
    """
    if len(scans) < MIN_SCANS:
        raise ExportError(f"{len(scans)} scans given to prove parity on, at least {MIN_SCANS} are needed; add --scans")
    config, detector = checkpoint.config, checkpoint.detector
    if not isinstance(detector, RefineDetector):
        raise ExportError(f"model.kind {config.model.kind}: not a second stage")
    model = with_first_stage(dataclasses.replace(detector.model, spec=pillar_spec(config)))
    stage = open_first_stage(model.first_stage)
    with tempfile.TemporaryDirectory() as temporary, atomic_directory(out, "asca export", MANIFEST) as folder:
        first = _first_bundle(model.first_stage, Path(temporary) / "first", scans, progress)
        proposing = load_bundle(first)
        shutil.copyfile(first / proposing.graphs[ENCODER].file, graphs.graph_path(folder, ENCODER))
        backbone = add_neck_output(onnx.load(first / proposing.graphs[BACKBONE].file))
        onnx.save(backbone, graphs.graph_path(folder, BACKBONE))
        progress("Exporting the second stage and proving parity")
        path, classes = graphs.graph_path(folder, REFINE), len(model.spec.classes)
        export_refine(detector.refiner, model.refine.neighbors, model.bev_channels, classes, path)
        draft = draft_bundle(
            checkpoint._replace(config=dataclasses.replace(config, model=model)),
            scans,
            trained_on,
            command,
            pillar=proposing.pillar,
            backbone_gmac=proposing.backbone_gmac,
            refine=RefineSection(model.bev_channels, model.refine.seen, model.refine.neighbors),
        )

        def prove(signed: Bundle) -> Parity:
            pipeline = RefinePipeline(folder, signed, threads=default_threads())
            return prove_refine_parity(detector.refiner, stage, pipeline, model, scans)

        return write_proven(folder, draft, prove)


def _first_bundle(
    source: str, temporary: Path, scans: Sequence[NDArray[np.float32]], progress: Callable[[str], None]
) -> Path:
    """Folder of the first stage as a float32 bundle; a checkpoint is exported to `temporary`."""
    if Path(source).suffix != CHECKPOINT_SUFFIX:
        return find_bundle(source)
    export_bundle(load_checkpoint(source), temporary, scans, progress=progress)
    return temporary
