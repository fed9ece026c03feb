"""Gain of a trained second stage over its first stage's proposals: 3D AP with and without it.

    asca simulate data/sim --frames 4000 --seed 7 --view camera
    asca simulate data/check --frames 300 --seed 2026 --view camera
    asca train asca_refine_sim --data data/sim --out runs/refine
    python -m benchmarks.refine_gain runs/refine/checkpoints/last.ckpt data/check

or, for PV-RCNN, of an exported bundle:

    asca export pvrcnn_small_sim -o pvrcnn
    python -m benchmarks.refine_gain pvrcnn data/check

All rows use the same proposals and the same suppression.
"""

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from asca_deploy import Detector
from asca_deploy.pv_rcnn.pipeline import PvRcnnPipeline
from asca_pillars.base.errors import ConfigError
from asca_pillars.base.progress import Reporter
from asca_pillars.base.system import cpu_model
from asca_pillars.cli.progress import Bars
from asca_pillars.cli.run_command import run_command
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.detection.decode import PostProcess
from asca_pillars.detection.detections import Detections
from asca_pillars.evaluation.kitti.average_precision import evaluate
from asca_pillars.evaluation.predictions import read_predictions, read_truth, write_predictions
from asca_pillars.evaluation.report_page import markdown_table
from asca_pillars.models.build import load_checkpoint
from asca_pillars.models.two_stage.first_stage import open_first_stage
from asca_pillars.models.two_stage.network import RefineDetector, refine_logits
from asca_pillars.models.two_stage.preparation import ProposalCache
from asca_pillars.ops.two_stage.decode import Scores, refined_detections, refined_scores

Refined = tuple[Detections, tuple[NDArray[np.float32], NDArray[np.float32]]]
"""R proposals of a frame, and the second stage's confidence (R,), logits, and residuals (R, 7) for them."""


def main(
    trained: Annotated[Path, typer.Argument(help="Checkpoint of kind pillar_refine, or bundle of kind pv_rcnn.")],
    check: Annotated[Path, typer.Argument(help="KITTI-layout folder to evaluate on.")],
    split: Annotated[str, typer.Option(help="Of that folder.")] = "training",
) -> None:
    """Evaluate and print."""
    frames = KittiSplit(check, split)
    found, post, about = _refined(trained, frames) if trained.is_file() else _pv_rcnn(trained, frames)

    def detections(frame_id: str, scores: Scores | None, new_boxes: bool) -> Detections:
        proposals, (confidence, residuals) = found[frame_id]
        chosen = proposals.scores if scores is None else refined_scores(proposals, confidence, scores)
        return refined_detections(proposals, chosen, residuals if new_boxes else 0 * residuals, post)

    class_names = found[frames.frame_ids[0]][0].class_names
    rows = []
    choices: tuple[tuple[str, Scores | None, bool], ...] = (
        ("first stage", None, False),
        ("its boxes, the second's scores", "second", False),
        ("its scores, new boxes", None, True),
        ("the second's scores, new boxes", "second", True),
        ("scores of both, new boxes", "both", True),
    )
    for name, scores, boxes in choices:
        values = moderate_ap(frames, class_names, partial(detections, scores=scores, new_boxes=boxes))
        rows.append((name, *(f"{value:.1f}" for value in values)))
    print(f"{cpu_model()}: {about}, {len(frames.frame_ids)} frames\n")
    print(markdown_table(("3D AP, moderate, R40", *class_names), rows, left=1))


def _refined(path: Path, frames: KittiSplit) -> tuple[dict[str, Refined], PostProcess, str]:
    checkpoint = load_checkpoint(path)
    detector = checkpoint.detector
    if not isinstance(detector, RefineDetector):
        raise ConfigError(f"{path}: of kind {checkpoint.config.model.kind}; give a bundle of it")
    settings = detector.model.refine
    stage = open_first_stage(detector.model.first_stage)
    cache = ProposalCache(Path(frames.root) / "prepared", frames.pool, stage, settings.seen)
    with Bars(Console(markup=False, stderr=True)) as bars:
        cache.fill(frames, reporter=Reporter(bars))
    found = {}
    for frame_id in frames.frame_ids:
        proposed, points = cache.files.read(frame_id), frames.points(frame_id, camera_view=True)
        found[frame_id] = proposed.proposals, refine_logits(detector.refiner, points, proposed, settings.neighbors)
    parameters = sum(weight.numel() for weight in detector.refiner.parameters())
    return found, checkpoint.config.model.spec.post, f"{parameters} parameters, {checkpoint.steps} steps"


def _pv_rcnn(bundle: Path, frames: KittiSplit) -> tuple[dict[str, Refined], PostProcess, str]:
    detector = Detector(bundle)
    pipeline = detector.pipeline
    if not isinstance(pipeline, PvRcnnPipeline):
        raise ConfigError(f"{bundle}: of kind {detector.bundle.kind}; give a bundle of kind pv_rcnn")
    found: dict[str, Refined] = {}
    for frame_id in track(frames.frame_ids, "Detecting"):
        raw = pipeline.infer(pipeline.prepare(frames.points(frame_id, camera_view=True), []), [])
        if raw.maps is None:
            nothing = np.empty(0, np.float32)
            found[frame_id] = Detections.empty(pipeline.spec.class_names), (nothing, nothing.reshape(0, 7))
            continue
        proposals, logits, residuals = pipeline.propose_and_refine(raw.maps, raw, [])
        found[frame_id] = proposals, (logits, residuals)
    return found, pipeline.spec.post, f"{detector.bundle.name}, {detector.runs_on}"


def moderate_ap(
    split: KittiSplit, class_names: tuple[str, ...], detections: Callable[[str], Detections]
) -> list[float]:
    """Return the 3D AP of each class, moderate, R40, percent."""
    frame_ids = iter(split.frame_ids)
    truth = read_truth(split.folder / "label_2", split.frame_ids)
    with tempfile.TemporaryDirectory() as folder:
        write_predictions(folder, split, lambda _: detections(next(frame_ids)))
        frames = read_predictions(folder, truth, split.folder / "label_2")
    results = evaluate(frames.truth, frames.detections, class_names).overall
    curves = [results.curve(name, "3d", "moderate") for name in results.class_names]
    return [0.0 if curve is None else curve.r40 for curve in curves]


if __name__ == "__main__":
    run_command(main)
