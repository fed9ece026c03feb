"""Fit of labels to points, by drive: the statistics of `asca simulate --report` for any folder in KITTI's layout.

    python -m benchmarks.label_fits data/kitti 0001 0005 0013      # lists in ImageSets, one drive each
    python -m benchmarks.label_fits data/sim --json fits.json      # all frames; also as the reference file holds them

Drives are sequences: hundreds of boxes are a dozen cars. Conclusions have to hold on several of them.
"""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import track

from asca_pillars.cli.run_command import run_command
from asca_pillars.data.kitti import KittiSplit, boxes_from_objects, objects_3d
from asca_pillars.scans.scan_reader import read_scan
from asca_pillars.sim.report.reference import CLASSES, Fit
from asca_pillars.sim.report.scan_statistics import fits_of, object_fits
from asca_pillars.sim.report.tables import fits_table


def main(
    folder: Annotated[Path, typer.Argument(help="KITTI layout.")],
    lists: Annotated[list[str] | None, typer.Argument(help="Names of lists in ImageSets; default: all frames.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the numbers here, too.")] = None,
) -> None:
    """Print a column for each list."""
    split = KittiSplit(folder)
    fits: dict[str, tuple[Fit, ...]] = {}
    for name in lists or [""]:
        frame_ids = (folder / "ImageSets" / f"{name}.txt").read_text().split() if name else split.frame_ids
        rows = [_of_frame(split, frame_id) for frame_id in track(frame_ids, name or str(folder))]
        stacked = {kind: np.concatenate([row[kind] for row in rows]) for kind in CLASSES}
        for statistic, found in fits_of(stacked, name or folder.name).items():
            fits[statistic] = fits.get(statistic, ()) + found
    Console(markup=False, highlight=False).print(fits_table(fits), soft_wrap=True)
    if json_file is not None:
        json_file.write_text(json.dumps({name: [asdict(fit) for fit in of] for name, of in fits.items()}))


def _of_frame(split: KittiSplit, frame_id: str) -> dict[str, np.ndarray]:
    objects = objects_3d(split.objects(frame_id))
    boxes = boxes_from_objects(objects, split.calibration(frame_id))
    return object_fits(read_scan(split.scan_path(frame_id)).points, objects, boxes)


if __name__ == "__main__":
    run_command(main)
