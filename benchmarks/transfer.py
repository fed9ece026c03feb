"""What a detector of simulated streets finds on real ones, at scores that were chosen on simulated ones.

    asca eval --data data/check --out evaluation/simulated
    asca eval --data data/kitti --split training --out evaluation/real
    python -m benchmarks.transfer data/check evaluation/simulated data/kitti evaluation/real

For every class the score with the best F1 on the simulated frames is taken; real frames have no say in it. At that
score stand recall of the objects that KITTI counts at moderate and false detections per frame, for the overlap in the
bird's-eye view that a class is asked for. `evaluation.verdicts` tells what is counted, false and excused.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from asca_pillars.evaluation.kitti import CLASS_NAMES
from asca_pillars.evaluation.operating_point import wilson_interval
from asca_pillars.evaluation.predictions import ScoredFrames, read_predictions, read_truth
from asca_pillars.evaluation.report import markdown_table
from asca_pillars.evaluation.verdicts import Scene, judge

OVERLAPS = (("Car", 0.5), ("Car", 0.7), ("Pedestrian", 0.25), ("Cyclist", 0.25))  # the first of a class chooses
SCORES = np.arange(0.10, 0.90, 0.02)


@dataclass(frozen=True)
class Outcome:
    """Counts of one class at one score and overlap over some frames."""

    frames: int
    objects: int
    found: int
    true: int
    false: int

    @property
    def recall(self) -> float:
        """Share of the counted objects that were found."""
        return self.found / max(self.objects, 1)

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        return 2 * self.found / max(self.objects + self.true + self.false, 1)

    @property
    def row(self) -> tuple[str, ...]:
        """For a table: found of objects, recall with its 95 % interval, false per frame."""
        low, high = wilson_interval(self.found, self.objects)
        per_frame = self.false / self.frames
        return f"{self.found}/{self.objects}", f"{self.recall:.2f} ({low:.2f}-{high:.2f})", f"{per_frame:.2f}"


def main(
    simulated: Annotated[Path, typer.Argument(help="KITTI-layout folder of simulated frames.")],
    simulated_out: Annotated[Path, typer.Argument(help="What `asca eval` wrote about it.")],
    real: Annotated[Path, typer.Argument(help="KITTI-layout folder of real frames.")],
    real_out: Annotated[Path, typer.Argument(help="What `asca eval` wrote about it.")],
) -> None:
    """Choose a score per class on simulated frames, and print what it gives there and on real frames."""
    sets = [_read(simulated, simulated_out), _read(real, real_out)]
    rows = []
    chosen: dict[str, float] = {}
    for name, overlap in OVERLAPS:
        if name not in chosen:
            chosen[name] = max(SCORES, key=lambda score: count(sets[0], name, overlap, score).f1)
        for title, frames in zip(("simulated", "real"), sets, strict=True):
            outcome = count(frames, name, overlap, chosen[name])
            rows.append((name, title, f"{chosen[name]:.2f}", f"{overlap}", *outcome.row))
    columns = ("class", "frames", "score", "BEV IoU", "found", "recall", "false per frame")
    print(f"{len(sets[0])} simulated and {len(sets[1])} real frames\n\n{markdown_table(columns, rows, left=2)}")


def count(frames: ScoredFrames, class_name: str, overlap: float, score: float) -> Outcome:
    """What becomes of the objects and detections of one class, moderate, bird's-eye view."""
    overlaps, scores = dict.fromkeys(CLASS_NAMES, overlap), dict.fromkeys(CLASS_NAMES, float(score))
    scene = Scene.of(frames.truth, frames.detections, CLASS_NAMES, scores, overlaps)
    verdict = judge(scene, class_name, "moderate", "bev")
    masks = (verdict.counted, verdict.found, verdict.true, verdict.false)
    return Outcome(len(frames), *(int(mask.sum()) for mask in masks))


def _read(data: Path, out: Path) -> ScoredFrames:
    labels = data / "training" / "label_2"
    predictions = out / "predictions"
    names = sorted(path.stem for path in predictions.glob("*.txt"))
    return read_predictions(predictions, read_truth(labels, names), labels)


if __name__ == "__main__":
    typer.run(main)
