"""What a detector of simulated streets finds on real ones, at scores that were chosen on simulated ones.

    asca eval --data data/check --out evaluation/simulated
    asca eval --data data/kitti --split training --out evaluation/real
    python -m benchmarks.transfer data/check evaluation/simulated data/kitti evaluation/real

For every class the score with the best F1 on the simulated frames is taken; real frames have no say in it. At that
score stand recall of the objects that KITTI counts at moderate and false detections per frame, for the overlap in the
bird's-eye view that a class is asked for. `evaluation.kitti.score_threshold` tells what counts and what is ignored.
"""

import math
from pathlib import Path
from typing import Annotated

import typer

from asca_pillars.commands.run_command import run_command
from asca_pillars.evaluation.kitti.average_precision import CLASS_NAMES
from asca_pillars.evaluation.kitti.operating_point import OperatingPoint, best_scores, operating_points
from asca_pillars.evaluation.predictions import ScoredFrames, read_predictions, read_truth
from asca_pillars.evaluation.recall import BEV_IOU, SMALL_BEV_IOU
from asca_pillars.evaluation.report_page import markdown_table

FOUND_IOU = {name: BEV_IOU.get(name, SMALL_BEV_IOU) for name in CLASS_NAMES}
OVERLAPS = (FOUND_IOU, {"Car": 0.7})  # the first ones choose the scores
COLUMNS = ("class", "frames", "score", "BEV IoU", "found", "recall", "95 % interval", "false per frame")


def main(
    simulated: Annotated[Path, typer.Argument(help="KITTI-layout folder of simulated frames.")],
    simulated_out: Annotated[Path, typer.Argument(help="What `asca eval` wrote about it.")],
    real: Annotated[Path, typer.Argument(help="KITTI-layout folder of real frames.")],
    real_out: Annotated[Path, typer.Argument(help="What `asca eval` wrote about it.")],
) -> None:
    """Choose a score per class on simulated frames, and print what it gives there and on real frames."""
    sets = {"simulated": read_evaluation(simulated, simulated_out), "real": read_evaluation(real, real_out)}
    chosen = sets["simulated"]
    best = best_scores(chosen.truth, chosen.detections, tuple(OVERLAPS[0]), min_overlap=OVERLAPS[0], metric="bev")
    scores = {name: math.floor(100 * score) / 100 for name, score in best.items()}
    rows = []
    for overlaps in OVERLAPS:
        names = [name for name in overlaps if name in scores]
        for title, frames in sets.items():
            points = operating_points(
                frames.truth, frames.detections, names, scores=scores, min_overlap=overlaps, metric="bev"
            )
            rows += [_row(point, title, len(frames)) for point in points]
    rows.sort(key=lambda row: (list(OVERLAPS[0]).index(row[0]), row[3]))
    print(f"{len(sets['simulated'])} simulated and {len(sets['real'])} real frames\n")
    print(markdown_table(COLUMNS, rows, left=2))


def _row(point: OperatingPoint, title: str, frames: int) -> tuple[str, ...]:
    low, high = point.recall_interval
    found = f"{point.found} of {point.objects}", f"{point.recall:.2f}", f"{low:.2f}-{high:.2f}"
    false = point.detections - point.true_positives
    return point.class_name, title, f"{point.score:.2f}", f"{point.min_overlap:g}", *found, f"{false / frames:.2f}"


def read_evaluation(data: Path, out: Path) -> ScoredFrames:
    """Labels of a KITTI-layout folder, and the predictions that `asca eval` wrote for it."""
    labels, predictions = data / "training" / "label_2", out / "predictions"
    truth = read_truth(labels, sorted(path.stem for path in predictions.glob("*.txt")))
    return read_predictions(predictions, truth, labels)


if __name__ == "__main__":
    run_command(main)
