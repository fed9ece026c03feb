"""Argoverse 2's sensor dataset: <log>/annotations.feather and <log>/sensors/lidar/<timestamp_ns>.feather.

Boxes and sweeps are in the vehicle's frame: x forward, y left, z up, origin on the rear axle near the ground. A sweep
is labelled by the boxes of its own timestamp. Format: https://argoverse.github.io/user-guide/datasets/lidar.html
"""

from collections import defaultdict
from pathlib import Path

import numpy as np

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.data.boxes.box_records import can_be_written, records_from
from asca_pillars.data.boxes.box_split import BoxDataset
from asca_pillars.data.importing.imported import Imported, ImportedFrame, SkippedEntries, text_of
from asca_pillars.geometry.frame_change import rotations_from_quaternions
from asca_pillars.scans.feather import feather_table
from asca_pillars.scans.find_scans import files_below

AXLE_HEIGHT_M = 0.33
"""Height of the vehicle's frame above the ground: a wheel's radius. Measured in the sweeps: 0.35."""
SENSOR_POSITION_M = (1.35, 0.0, 1.64)
"""Position of the upper one of the two stacked LiDARs, from the logs' calibrations."""
_CENTER = ("tx_m", "ty_m", "tz_m")
_SIZE = ("length_m", "width_m", "height_m")
_TURN = ("qw", "qx", "qy", "qz")


def read_argoverse2(root: Path, reporter: Reporter = SILENT) -> Imported:
    """Read every sweep with boxes of every log below `root`.

    Raises:
        DatasetError: no log, or a file that is not of this format.
        AscaError: pyarrow is not installed.
    """
    root = root.resolve()  # scans are named relative to it, including links
    logs = sorted(path.parent for path in files_below(root) if path.name == "annotations.feather")
    if not logs:
        raise DatasetError(f"{root}: no annotations.feather below; give a folder of Argoverse 2 logs")
    skipped = SkippedEntries()
    frames = [frame for log in reporter.track(logs, "Reading logs") for frame in _frames(log, skipped)]
    settings = BoxDataset(
        sensor_height=AXLE_HEIGHT_M, reflectance_scale=255.0, scans=str(root), sensor_position=SENSOR_POSITION_M
    )
    return Imported(settings, frames, skipped)


def _frames(log: Path, skipped: SkippedEntries) -> list[ImportedFrame]:
    path = log / "annotations.feather"
    numbers = ("timestamp_ns", *_CENTER, *_SIZE, *_TURN)
    table = feather_table(path, numbers, ("track_uuid", "category"), DatasetError)
    stamps = table["timestamp_ns"]
    if stamps.dtype.kind not in "iu":
        raise DatasetError(f"{path}: column `timestamp_ns` does not hold whole numbers; copy the file again")
    with np.errstate(invalid="ignore", over="ignore"):
        turns = rotations_from_quaternions(np.column_stack([table[name] for name in _TURN]).astype(np.float64))
        yaw = np.arctan2(turns[:, 1, 0], turns[:, 0, 0])
        boxes = np.column_stack([*(table[name] for name in (*_CENTER, *_SIZE)), yaw]).astype(np.float64)
        can = can_be_written(boxes)
    kept: dict[int, list[int]] = defaultdict(list)
    for row in range(len(stamps)):
        try:
            text_of(table["category"][row], "category")
            text_of(table["track_uuid"][row], "track_uuid")
            if not can[row]:
                values = ", ".join(f"{name} {table[name][row]:g}" for name in (*_CENTER, *_SIZE, *_TURN))
                raise ValueError(f"no box with finite numbers, positive sizes and a rotation ({values})")
            kept[int(stamps[row])].append(row)
        except ValueError as reason:
            kept[int(stamps[row])]  # the sweep is kept
            skipped.add("boxes", f"{path}, row {row}", reason)
    frames = []
    for stamp, rows in sorted(kept.items()):
        folders = (log / "sensors" / "lidar", log / "lidar")
        scan = next((scan for folder in folders if (scan := folder / f"{stamp}.feather").is_file()), None)
        if scan is None:
            continue  # only a part of a log may have been downloaded
        types, tracks = (table[name][rows].tolist() for name in ("category", "track_uuid"))
        frames.append(ImportedFrame(scan, records_from(boxes[rows], types, None, tracks), log.name))
    return frames
