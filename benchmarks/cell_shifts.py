"""Does it depend on where the grid's cells lie whether an object is found? The same scans, moved by parts of a cell.

    asca simulate data/check --frames 1000 --seed 2026 --view camera --val-share 1
    python -m benchmarks.cell_shifts data/check asca_sim_int8 asca_small_sim_int8

Every scan is detected as it is and moved by each combination of SHIFTS_M along x and y, 15 more times. Objects that
count lie within RANGE_M and hold FEWEST_POINTS points or more. One is found if a detection of its class overlaps it by
`evaluation.recall.BEV_IOU`, seen from above; a detection finds one object.
"""

from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import track

from asca_deploy import Detector
from asca_pillars.commands.run_command import run_command
from asca_pillars.data.frames import LabeledFrame, read_frame
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.evaluation.recall import BEV_IOU, SMALL_BEV_IOU
from asca_pillars.evaluation.report_page import markdown_table
from asca_pillars.geometry.assignment import match_by_overlap
from asca_pillars.geometry.detections import Detections
from asca_pillars.geometry.overlap import bev_iou

SHIFTS_M = (0.0, 0.08, 0.16, 0.24)
RANGE_M = 25.0
FEWEST_POINTS = 20
COLUMNS = ("bundle", "objects", "found, mean", "least", "most", "found always", "never", "median score")


def main(
    data: Annotated[Path, typer.Argument(help="KITTI-layout folder.")],
    bundles: Annotated[list[str], typer.Argument(help="Folders, or names of bundles that ship.")],
    name: Annotated[str, typer.Option("--class", help="Class to look at.")] = "Pedestrian",
    frames: Annotated[int, typer.Option(min=1, help="The first so many that have such an object.")] = 40,
) -> None:
    """Print how many objects of one class are found, for the best shift, the worst and the mean of all."""
    chosen = _frames_with(KittiSplit(data, "val"), name, frames)
    rows = []
    for bundle in bundles:
        detector = Detector(bundle)
        scores = np.concatenate([scores_by_shift(detector, frame, name) for frame in track(chosen, bundle)], axis=1)
        found = scores > 0
        by_shift, by_object = found.mean(axis=1), found.mean(axis=0)
        shares = (by_shift.mean(), by_shift.min(), by_shift.max(), (by_object == 1).mean(), (by_object == 0).mean())
        middle = f"{np.median(scores[found]):.2f}"
        rows.append((bundle, str(scores.shape[1]), *(f"{share:.3f}" for share in shares), middle))
    print(markdown_table(COLUMNS, rows, left=1))


def _frames_with(split: KittiSplit, name: str, count: int) -> list[LabeledFrame]:
    """Frames with objects that count, and those objects alone."""
    chosen: list[LabeledFrame] = []
    for frame_id in split.frame_ids:
        if len(chosen) == count:
            break
        frame = read_frame(split, frame_id, (name,), min_points=FEWEST_POINTS)
        counts = (frame.labels == 0) & (np.hypot(frame.boxes[:, 0], frame.boxes[:, 1]) < RANGE_M)
        if counts.any():
            chosen.append(LabeledFrame(frame_id, frame.points, frame.boxes[counts], frame.labels[counts]))
    return chosen


def scores_by_shift(
    detector: Callable[[NDArray[np.float32]], Detections], frame: LabeledFrame, name: str
) -> NDArray[np.float64]:
    """(shifts, objects) score of the detection that finds an object, 0 if none does."""
    least = BEV_IOU.get(name, SMALL_BEV_IOU)
    scores = np.zeros((len(SHIFTS_M) ** 2, len(frame.boxes)))
    for number, (dx, dy) in enumerate(product(SHIFTS_M, SHIFTS_M)):
        points, boxes = frame.points.copy(), frame.boxes.copy()
        points[:, :2] += np.array([dx, dy], np.float32)
        boxes[:, :2] += np.array([dx, dy], np.float32)
        found = detector(points)
        found = found[[detection.class_name == name for detection in found]]
        detections, objects = match_by_overlap(bev_iou(found.boxes, boxes), least)
        scores[number, objects] = found.scores[detections]
    return scores


if __name__ == "__main__":
    run_command(main)
