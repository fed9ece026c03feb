"""Systematic errors of boxes, and what they cost in AP: for example, where labels follow another convention.

    asca eval --data data/check --out evaluation
    python -m benchmarks.box_errors data/check evaluation --class Pedestrian --score 0.45

Errors are of the pairs of a counted object (moderate) and a detection that covers it from above, at BEV IoU 0.5 (cars)
or 0.25. Then the median error is taken away from every box of the class, and the AP is that of the corrected boxes.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from asca_pillars.commands.run_command import run_command
from asca_pillars.errors import ConfigError
from asca_pillars.evaluation.kitti.average_precision import CLASS_NAMES, DIFFICULTIES, evaluate
from asca_pillars.evaluation.kitti.objects import FrameObjects
from asca_pillars.evaluation.kitti.score_threshold import MatchInput, match_class
from asca_pillars.evaluation.kitti.states import is_type
from asca_pillars.evaluation.predictions import ScoredFrames
from asca_pillars.evaluation.report_page import markdown_table
from benchmarks.transfer import FOUND_IOU, read_evaluation

PLACES, SIZES = ("farther", "to the right", "lower"), ("higher", "wider", "longer")
Errors = NDArray[np.float64]
"""(6,) or (N, 6) metres: `PLACES` of the middle of the bottom, seen from the camera, then `SIZES`."""


def main(
    data: Annotated[Path, typer.Argument(help="KITTI-layout folder.")],
    out: Annotated[Path, typer.Argument(help="What `asca eval` wrote about it.")],
    name: Annotated[str, typer.Option("--class", help="Class to look at.")] = "Pedestrian",
    score: Annotated[float, typer.Option(help="Detections from this score on count.")] = 0.45,
) -> None:
    """Print the errors, and the AP as it is and without their medians."""
    if name not in CLASS_NAMES:
        raise ConfigError(f"--class {name}: choose one of {', '.join(CLASS_NAMES)}")
    frames = read_evaluation(data, out)
    errors = box_errors(frames, name, score)
    if not len(errors):
        raise ConfigError(f"--score {score:g}: no {name} of {out} has this score and covers one that counts; lower it")
    middle = np.median(errors, axis=0)
    spread = np.subtract(*np.quantile(errors, (0.75, 0.25), axis=0)) / 2
    rows = [
        (what, f"{100 * median:+.1f}", f"{100 * half:.1f}")
        for what, median, half in zip((*PLACES, *SIZES), middle, spread, strict=True)
    ]
    print(
        markdown_table(
            (f"{name}, {len(errors)} pairs", "median (cm)", "half the interquartile range (cm)"), rows, left=1
        )
    )
    ways = {
        "as they are": np.zeros(6),
        "without the medians of places": middle * (1, 1, 1, 0, 0, 0),
        "without those of sizes": middle * (0, 0, 0, 1, 1, 1),
        "without both": middle,
    }
    results = [(what, *average_precision(frames, name, taken)) for what, taken in ways.items()]
    print(markdown_table(("3D AP R40", *DIFFICULTIES), results, left=1))


def box_errors(frames: ScoredFrames, name: str, score: float) -> Errors:
    """(N, 6) of the pairs, see `Errors`."""
    inputs = MatchInput.of(frames.truth, frames.detections, CLASS_NAMES, dict.fromkeys(CLASS_NAMES, score), FOUND_IOU)
    counted = match_class(inputs, name, "moderate", "bev").counted
    found, truth = inputs.frames.detections, inputs.frames.truth
    meant = is_type(found, name) & (found.scores >= score)
    pairs = inputs.pairs.where(inputs.pairs.overlaps["bev"] >= FOUND_IOU[name])
    pairs = pairs.where(counted[pairs.truth] & meant[pairs.detection])
    apart = found.locations[pairs.detection] - truth.locations[pairs.truth]
    farther, right = ((apart[:, ::2] * axis).sum(axis=1) for axis in _axes(truth.locations[pairs.truth]))
    places = np.stack([farther, right, apart[:, 1]], axis=1)
    return np.concatenate([places, found.dimensions_hwl[pairs.detection] - truth.dimensions_hwl[pairs.truth]], axis=1)


def average_precision(frames: ScoredFrames, name: str, taken: Errors) -> Sequence[str]:
    """3D AP of easy, moderate and hard objects, with these errors (6,) taken away from the boxes of the class."""
    better = [_corrected(one, name, taken) for one in frames.detections]
    metrics = evaluate(frames.truth, better, (name,)).overall.to_json()[name]
    assert metrics is not None, "there are detections of the class"
    return [f"{value:.1f}" for value in metrics["3d"]["R40"]]


def _corrected(found: FrameObjects, name: str, taken: Errors) -> FrameObjects:
    mine = is_type(found, name)[:, None]
    along, across = _axes(found.locations)
    moved = np.insert(along * taken[0] + across * taken[1], 1, taken[2], axis=1)
    return replace(
        found,
        locations=found.locations - mine * moved,
        dimensions_hwl=np.where(mine, np.maximum(found.dimensions_hwl - taken[3:], 0.1), found.dimensions_hwl),
    )


def _axes(locations: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """x and z (N, 2) of the direction in which the camera sees each place (N, 3), and of the one to the right of it."""
    ground = locations[:, ::2]
    along = np.asarray(ground / np.linalg.norm(ground, axis=1, keepdims=True))
    return along, along[:, ::-1] * (1, -1)


if __name__ == "__main__":
    run_command(main)
