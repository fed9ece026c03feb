"""What a second stage makes of the shipped model's proposals: trained for some minutes, 3D AP with and without it.

    asca simulate data/sim --frames 4000 --seed 7 --view camera
    asca simulate data/check --frames 300 --seed 2026 --view camera
    python -m benchmarks.refine_gain data/sim data/check --minutes 10

All rows are the same proposals through the same suppression.
"""

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from rich.console import Console

from asca_export.bundle_first_stage import BundleFirstStage
from asca_pillars.data.frames import read_frame, within_ranges
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.evaluation.kitti.average_precision import evaluate
from asca_pillars.evaluation.predictions import read_predictions, read_truth, write_predictions
from asca_pillars.evaluation.report import markdown_table
from asca_pillars.files import atomic_path
from asca_pillars.geometry.detections import Detections
from asca_pillars.models.refine.refine_detector import build_refiner
from asca_pillars.models.refine.refine_loss import RefineTerms
from asca_pillars.models.second_stage.proposal_cache import ProposalCache
from asca_pillars.models.second_stage.refine_sample import RefineSample, prepare_sample
from asca_pillars.models.second_stage.refine_training import sample_batches, train_refiner
from asca_pillars.models.second_stage.refined_detector import judge
from asca_pillars.points.first_stage import FirstStageSettings
from asca_pillars.points.refine_geometry import RefineSettings
from asca_pillars.points.refined_detections import refined_detections
from asca_pillars.refine_config import RefineConfig, RefineNetwork
from asca_pillars.system import cpu_model


def main(
    data: Annotated[Path, typer.Argument(help="KITTI-layout folder to train on.")],
    check: Annotated[Path, typer.Argument(help="KITTI-layout folder to evaluate on.")],
    split: Annotated[str, typer.Option(help="Of the folder to train on.")] = "train",
    bundle: Annotated[str, typer.Option(help="First stage, in float32.")] = "asca_small_sim",
    minutes: Annotated[float, typer.Option(help="Of training, wall time.")] = 10.0,
    batch_size: Annotated[int, typer.Option(help="Frames of a step.")] = 4,
    rois: Annotated[int, typer.Option(help="Proposals of a frame that are learnt from.")] = 32,
    width: Annotated[int, typer.Option(help="Channels of pooled features.")] = 32,
    grid_size: Annotated[int, typer.Option(help="Grid points along each axis of a box.")] = 4,
    samples: Annotated[int, typer.Option(help="Points of a ball.")] = 16,
    learning_rate: Annotated[float, typer.Option()] = 3e-3,
    seed: Annotated[int, typer.Option()] = 0,
    out: Annotated[Path | None, typer.Option(help="File for the weights.")] = None,
) -> None:
    """Train, evaluate and print."""
    console = Console(markup=False)
    stage, settings = (
        BundleFirstStage(bundle),
        RefineSettings(ball_samples=samples, grid_samples=samples, grid_size=grid_size),
    )
    torch.manual_seed(seed)
    training, checking = KittiSplit(data, split), KittiSplit(check, "training")
    caches = [ProposalCache(Path(s.root) / "prepared", stage, FirstStageSettings()) for s in (training, checking)]
    for cache, frames in zip(caches, (training, checking), strict=True):
        cache.fill(frames, console=console)

    def prepare(number: int, rng: np.random.Generator) -> RefineSample:
        frame_id = training.frame_ids[number]
        frame = within_ranges(read_frame(training, frame_id, stage.spec.class_names), stage.spec.ranges)
        return prepare_sample(frame, caches[0].files.read(frame_id), settings, rois, rng)

    bev_channels = caches[0].files.read(training.frame_ids[0]).bev.shape[1]
    widths = RefineNetwork((width // 2, width), 2 * width, (width, width), 4 * width)
    network = build_refiner(bev_channels, len(stage.spec.classes), RefineConfig(neighbors=settings, network=widths))
    means = np.zeros(4)

    def report(step: int, terms: RefineTerms) -> None:
        nonlocal means
        means += [float(term.detach()) for term in terms]
        if step % 25 == 0:
            named = zip(terms._fields, means / 25, strict=True)
            console.print(f"step {step}: " + ", ".join(f"{name} {value:.3f}" for name, value in named))
            means = np.zeros(4)

    batches = sample_batches(prepare, len(training.frame_ids), batch_size, seed)
    steps = train_refiner(network, batches, learning_rate=learning_rate, seconds=60 * minutes, report=report)
    parameters = sum(weight.numel() for weight in network.parameters())
    print(f"{cpu_model()}: {parameters} parameters, {steps} steps, {steps * batch_size} samples\n")

    if out is not None:
        with atomic_path(out) as temporary:
            torch.save(network.state_dict(), temporary)

    post, class_names = stage.spec.post, stage.spec.class_names
    found = {}
    for frame_id in checking.frame_ids:
        proposed, points = caches[1].files.read(frame_id), checking.points(frame_id, camera_view=True)
        found[frame_id] = proposed.proposals, judge(network, points, proposed, settings)

    def detections(frame_id: str, new_scores: bool, new_boxes: bool) -> Detections:
        proposals, (scores, residuals) = found[frame_id]
        return refined_detections(
            proposals, scores if new_scores else proposals.scores, residuals if new_boxes else 0 * residuals, post
        )

    rows = []
    for name, scores, boxes in (
        ("first stage", False, False),
        ("its boxes, new scores", True, False),
        ("its scores, new boxes", False, True),
        ("refined", True, True),
    ):
        values = moderate_ap(checking, class_names, partial(detections, new_scores=scores, new_boxes=boxes))
        rows.append((name, *(f"{value:.1f}" for value in values)))
    print(markdown_table(("3D AP, moderate, R40", *class_names), rows, left=1))


def moderate_ap(
    split: KittiSplit, class_names: tuple[str, ...], detections: Callable[[str], Detections]
) -> list[float]:
    """3D AP of each class, moderate, R40, percent."""
    frame_ids = iter(split.frame_ids)
    truth = read_truth(split.folder / "label_2", split.frame_ids)
    with tempfile.TemporaryDirectory() as folder:
        write_predictions(folder, split, lambda _: detections(next(frame_ids)))
        frames = read_predictions(folder, truth, split.folder / "label_2")
    results = evaluate(frames.truth, frames.detections, class_names).overall
    curves = [results.curve(name, "3d", "moderate") for name in results.class_names]
    return [0.0 if curve is None else curve.r40 for curve in curves]


if __name__ == "__main__":
    typer.run(main)
