"""A made-up dataset with boxes in the LiDAR frame: the scenes of `tests.helpers.scenes`, without a camera."""

from pathlib import Path

import numpy as np

from asca_pillars.data.boxes.box_records import json_line, records_from
from asca_pillars.data.kitti import write_image_set
from asca_pillars.scans.scan_reader import write_scan
from tests.helpers.scenes import make_scene


def write_box_dataset(
    root: Path, frames: int, val_frames: int = 1, names: tuple[str, ...] = ("Car", "Forklift")
) -> Path:
    """A folder with dataset.yaml, scans/, labels.jsonl and lists; the last `val_frames` are listed for validation."""
    ids = [f"{number:06d}" for number in range(frames)]
    drawn = tuple("Pedestrian" if name == "Forklift" else name for name in names)
    lines = []
    for number, frame_id in enumerate(ids):
        points, boxes, _ = make_scene(number, drawn)
        write_scan(root / "scans" / f"{frame_id}.bin", points)
        lines.append(json_line(f"{frame_id}.bin", records_from(np.asarray(boxes), names)))
    (root / "labels.jsonl").write_text("".join(lines))
    (root / "dataset.yaml").write_text("")
    write_image_set(root, "train", ids[: frames - val_frames])
    write_image_set(root, "val", ids[frames - val_frames :])
    return root
