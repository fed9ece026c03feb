"""Datasets with boxes of stated sizes."""

from pathlib import Path

import numpy as np

from asca_pillars.data.boxes.box_records import json_line, records_from
from asca_pillars.data.kitti import write_image_set
from asca_pillars.scans.scan_reader import write_scan

SIZES = {"Forklift": (2.6, 1.2, 2.2), "Pallet": (1.2, 0.8, 0.15)}


def write_around(root: Path, frames: int, *, reach_m: float, z_m: float = 0.0) -> Path:
    """Boxes full of points all around the sensor, standing on z_m."""
    rng = np.random.default_rng(0)
    lines = []
    for number in range(frames):
        boxes = []
        for size in SIZES.values():
            turn, away = rng.uniform(-np.pi, np.pi), rng.uniform(4, reach_m)
            spread = np.array(size) * rng.uniform(0.9, 1.1, 3)
            boxes.append([away * np.cos(turn), away * np.sin(turn), z_m + spread[2] / 2, *spread, rng.uniform(-3, 3)])
        array = np.array(boxes)
        points = np.repeat(array[:, :3], 20, axis=0) + rng.uniform(-0.05, 0.05, (40, 3))
        write_scan(root / "scans" / f"{number}.bin", np.column_stack([points, rng.random(40)]))
        lines.append(json_line(f"{number}.bin", records_from(array, list(SIZES))))
    (root / "labels.jsonl").write_text("".join(lines))
    (root / "dataset.yaml").write_text("")
    write_image_set(root, "train", [str(number) for number in range(frames)])
    return root
