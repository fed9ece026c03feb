"""Why boxes that are right from above fail in 3D: errors of bottom and height, and what each of them costs.

    asca eval --data data/check --out evaluation
    python -m benchmarks.heights data/check evaluation --class Car --score 0.47

Looked at are the pairs of a counted object (moderate) and a detection whose bird's-eye IoU reaches KITTI's minimum.
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
from benchmarks.transfer import read_evaluation

DISTANCES_M = (0, 20, 40, 80)
ERRORS = ("bottom, mean and sd (cm)", "height, mean and sd (cm)")
SHARES = ("3D as it is", "with the label's bottom", "with its height", "with both")


def main(
    data: Annotated[Path, typer.Argument(help="KITTI-layout folder.")],
    out: Annotated[Path, typer.Argument(help="What `asca eval` wrote about it.")],
    name: Annotated[str, typer.Option("--class", help="Class to look at.")] = "Car",
    score: Annotated[float, typer.Option(help="Detections from this score on count.")] = 0.47,
) -> None:
    """Print errors by distance, and the share of pairs that reach the minimum in 3D too, as it is and corrected."""
    evaluated = read_evaluation(data, out)
    inputs = MatchInput.of(evaluated.truth, evaluated.detections, CLASS_NAMES, score, None)
    least, frames = inputs.min_overlap[name], inputs.frames
    counted = match_class(inputs, name, "moderate", "bev").counted
    pairs = inputs.pairs.where(inputs.pairs.overlaps["bev"] >= least)
    pairs = pairs.where(counted[pairs.truth] & is_type(frames.detections, name)[pairs.detection])
    truth, found = frames.truth.dimensions_hwl[pairs.truth], frames.detections.dimensions_hwl[pairs.detection]
    # The camera's y points down, and a location is the middle of the bottom.
    low = frames.truth.locations[pairs.truth, 1] - frames.detections.locations[pairs.detection, 1]
    taller = found[:, 0] - truth[:, 0]
    areas = truth[:, 1] * truth[:, 2], found[:, 1] * found[:, 2]
    bev = pairs.overlaps["bev"]
    shared = bev * (areas[0] + areas[1]) / (1 + bev)

    def good(low: NDArray[np.float64], taller: NDArray[np.float64]) -> NDArray[np.bool_]:
        height = truth[:, 0]
        common = shared * np.clip(np.minimum(height, low + height + taller) - np.maximum(low, 0), 0, None)
        return np.asarray(common / (areas[0] * height + areas[1] * (height + taller) - common) >= least)

    none = np.zeros(len(bev))
    corrected = good(low, taller), good(none, taller), good(low, none), good(none, none)
    distances = frames.truth.distances_m[pairs.truth]
    rows = []
    for nearest, farthest in (*pairwise(DISTANCES_M), (DISTANCES_M[0], DISTANCES_M[-1])):
        band = (distances >= nearest) & (distances < farthest)
        if band.any():
            errors = (f"{100 * error[band].mean():+.1f}, {100 * error[band].std():.1f}" for error in (low, taller))
            shares = (f"{mask[band].mean():.2f}" for mask in corrected)
            rows.append((f"{nearest}-{farthest} m", str(band.sum()), *errors, *shares))
    print(markdown_table(("distance", "pairs", *ERRORS, *SHARES), rows, left=1))


if __name__ == "__main__":
    run_command(main)
