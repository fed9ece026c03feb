"""Argoverse 2's sensor dataset: <log>/annotations.feather and <log>/sensors/lidar/<timestamp_ns>.feather.

Boxes and sweeps are in the vehicle's frame: x forward, y left, z up, origin on the rear axle near the ground. A sweep
is labelled by the boxes of its own timestamp. Format: https://argoverse.github.io/user-guide/datasets/lidar.html
"""

from pathlib import Path

import numpy as np
from rich.progress import track

from asca_pillars.data.boxes.box_records import records_from
from asca_pillars.data.boxes.box_split import BoxDataset
from asca_pillars.data.importing.imported import Imported, ImportedFrame
from asca_pillars.data.scans.feather import feather_table
from asca_pillars.data.scans.find_scans import files_below
from asca_pillars.errors import DatasetError
from asca_pillars.geometry.rotations import of_quaternions

AXLE_HEIGHT_M = 0.33
"""Of the vehicle's frame above the ground: a wheel's radius. The sweeps themselves show 0.35."""
SENSOR_POSITION_M = (1.35, 0.0, 1.64)
"""Of the upper one of the two stacked LiDARs, by the calibrations that come with the logs."""
_CENTER = ("tx_m", "ty_m", "tz_m")
_SIZE = ("length_m", "width_m", "height_m")
_TURN = ("qw", "qx", "qy", "qz")


def read_argoverse2(root: Path) -> Imported:
    """Every sweep of every log below `root` that has boxes.

    Raises:
        DatasetError: no log, or a file that is not of this format.
        AscaError: pyarrow is not installed.
    """
    root = root.resolve()  # scans keep their names below it, where they are links too
    logs = sorted(path.parent for path in files_below(root) if path.name == "annotations.feather")
    if not logs:
        raise DatasetError(f"{root}: no annotations.feather below; give a folder of Argoverse 2 logs")
    frames = [frame for log in track(logs, "Reading logs", transient=True) for frame in _frames(log)]
    settings = BoxDataset(
        sensor_height=AXLE_HEIGHT_M, reflectance_scale=255.0, scans=str(root), sensor_position=SENSOR_POSITION_M
    )
    return Imported(settings, frames)


def _frames(log: Path) -> list[ImportedFrame]:
    path = log / "annotations.feather"
    numbers = ("timestamp_ns", *_CENTER, *_SIZE, *_TURN)
    table = feather_table(path, numbers, ("track_uuid", "category"), DatasetError)
    turns = of_quaternions(np.column_stack([table[name] for name in _TURN]))
    yaw = np.arctan2(turns[:, 1, 0], turns[:, 0, 0])
    boxes = np.column_stack([*(table[name] for name in (*_CENTER, *_SIZE)), yaw]).astype(np.float64)
    if not (np.isfinite(boxes).all() and (boxes[:, 3:6] > 0).all()):
        row = int(np.argmin(np.isfinite(boxes).all(axis=1) & (boxes[:, 3:6] > 0).all(axis=1)))
        values = ", ".join(f"{name} {table[name][row]:g}" for name in (*_CENTER, *_SIZE, *_TURN))
        raise DatasetError(
            f"{path}: row {row} is no box with finite numbers, positive sizes and a rotation ({values}); "
            "download it again"
        )
    frames = []
    for stamp in np.unique(table["timestamp_ns"]).tolist():
        folders = (log / "sensors" / "lidar", log / "lidar")
        scan = next((scan for folder in folders if (scan := folder / f"{stamp}.feather").is_file()), None)
        if scan is None:
            continue  # a part of a log may have been downloaded
        own = table["timestamp_ns"] == stamp
        records = records_from(boxes[own], table["category"][own].tolist(), None, table["track_uuid"][own].tolist())
        frames.append(ImportedFrame(scan, records, log.name))
    return frames
