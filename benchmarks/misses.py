"""Where a detector misses what it should find: recall by distance, by occlusion and by how near the next one stands.

    asca eval --data data/check --out evaluation
    python -m benchmarks.misses data/check evaluation --class Pedestrian --score 0.37

Objects that KITTI counts at moderate, found at BEV IoU 0.5 (cars) or 0.25, matched as in
`evaluation.kitti.score_threshold`.
"""

from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from asca_pillars.commands.run_command import run_command
from asca_pillars.evaluation.kitti.average_precision import CLASS_NAMES
from asca_pillars.evaluation.kitti.score_threshold import MatchInput, match_class
from asca_pillars.evaluation.kitti.states import is_type
from asca_pillars.evaluation.report_page import markdown_table
from benchmarks.transfer import FOUND_IOU, read_evaluation

DISTANCES_M = (0, 15, 25, 40, 80)
NEIGHBORS_M = (0, 1, 2, 1000)


def main(
    data: Annotated[Path, typer.Argument(help="KITTI-layout folder.")],
    out: Annotated[Path, typer.Argument(help="What `asca eval` wrote about it.")],
    name: Annotated[str, typer.Option("--class", help="Class to look at.")] = "Pedestrian",
    score: Annotated[float, typer.Option(help="Detections from this score on count.")] = 0.37,
) -> None:
    """Print recall of one class by what makes objects hard to find."""
    frames = read_evaluation(data, out)
    inputs = MatchInput.of(frames.truth, frames.detections, CLASS_NAMES, dict.fromkeys(CLASS_NAMES, score), FOUND_IOU)
    matches, truth, found = match_class(inputs, name, "moderate", "bev"), inputs.frames.truth, inputs.frames.detections
    nearest = _nearest_m(truth.locations[:, [0, 2]], inputs.frames.truth_frames, is_type(truth, name))
    groups = {f"{low}-{high} m away": _within(truth.distances_m, low, high) for low, high in pairwise(DISTANCES_M)}
    groups |= {f"occlusion {state}": truth.occluded == state for state in (0, 1)}
    groups |= {f"next {name} at {low}-{high} m": _within(nearest, low, high) for low, high in pairwise(NEIGHBORS_M)}
    rows = []
    for title, mask in groups.items():
        objects, hits = int((matches.counted & mask).sum()), int((matches.found & mask).sum())
        rows.append((title, str(objects), f"{hits / max(objects, 1):.2f}"))
    print(markdown_table((name, "objects", "recall"), rows, left=1))
    pairs = inputs.pairs
    good = pairs.overlaps["bev"] > FOUND_IOU[name]
    weak = good & is_type(found, name)[pairs.detection] & (found.scores[pairs.detection] < score)
    below = np.isin(np.flatnonzero(matches.missed), pairs.truth[weak]).sum()
    print(f"{matches.missed.sum()} missed, {below} of them with a box of their class below {score:g}")


def _nearest_m(places: NDArray[np.float64], frames: NDArray[np.int64], own: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Distance (N,) to the nearest other object of the class in the same frame."""
    nearest = np.full(len(places), np.nextafter(NEIGHBORS_M[-1], 0))
    for index in np.flatnonzero(own):
        others = np.flatnonzero(own & (frames == frames[index]))
        others = others[others != index]
        if len(others):
            nearest[index] = min(np.linalg.norm(places[others] - places[index], axis=1).min(), nearest[index])
    return nearest


def _within(values: NDArray[np.float64], low: float, high: float) -> NDArray[np.bool_]:
    return (values >= low) & (values < high)


if __name__ == "__main__":
    run_command(main)
