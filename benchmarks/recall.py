"""Recall and false detections per frame of a bundle at its thresholds, on a KITTI-layout dataset.

    asca simulate data/check --frames 300 --seed 900 --view camera --val-share 1
    python benchmarks/recall.py data/check

BEV IoU 0.5 for cars, 0.25 for pedestrians and cyclists. Detections that the camera does not see are left out, because
KITTI labels nothing else; Van and Person_sitting, DontCare areas and objects without points excuse a detection.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from asca_deploy import Detector
from asca_pillars.data.frames import read_frame
from asca_pillars.data.kitti import KittiSplit, image_boxes
from asca_pillars.evaluation.recall import RecallTally


def main(
    data: Annotated[Path, typer.Argument(help="KITTI-layout folder.")],
    frames: Annotated[str, typer.Option(help="A list of ImageSets/, or `training` for every frame.")] = "val",
    bundle: Annotated[Path | None, typer.Option(help="Default: the bundle that ships.")] = None,
    max_distance_m: Annotated[float, typer.Option(help="Count objects and detections nearer than this.")] = 40.0,
    score: Annotated[float | None, typer.Option(help="Threshold for every class. Default: the bundle's.")] = None,
) -> None:
    """Print recall and false detections per frame."""
    console = Console()
    detector = Detector(bundle, score_threshold=score)
    split = KittiSplit(data, frames)
    tally = RecallTally(detector.spec.class_names, max_distance_m)
    for frame_id in track(split.frame_ids, "Detecting", console=console):
        frame = read_frame(split, frame_id, detector.spec.class_names)
        detections = detector(frame.points)
        image, _ = image_boxes(detections.boxes, split.calibration(frame_id), split.image_size_wh(frame_id))
        visible = image[:, 2] > image[:, 0]
        areas = np.array([item.bbox for item in split.objects(frame_id) if item.type == "DontCare"]).reshape(-1, 4)
        excused = _share_within(image[visible], areas) > 0.5
        tally.add(detections[visible], frame.boxes, frame.labels, excused)
    table = Table(title=f"{detector.bundle.name}: {len(split.frame_ids)} frames, up to {max_distance_m:g} m")
    for column in ("class", "objects", "found", "recall", "false per frame"):
        table.add_column(column, justify="right")
    for name, row in tally.rows().items():
        table.add_row(name, str(row.objects), str(row.found), f"{row.recall:.3f}", f"{row.false_per_frame:.3f}")
    console.print(table)


def _share_within(boxes: NDArray[np.float64], areas: NDArray[np.float64]) -> NDArray[np.float64]:
    """Largest share of each image box (N, 4) that lies within one of the areas (M, 4)."""
    low = np.maximum(boxes[:, None, :2], areas[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], areas[None, :, 2:])
    shared = np.prod(np.clip(high - low, 0, None), axis=2).max(axis=1, initial=0.0)
    return shared / np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)


if __name__ == "__main__":
    typer.run(main)
