"""KITTI's raw recordings: <date>/<drive>_sync/tracklet_labels.xml and velodyne_points/data/<frame>.bin.

A tracklet has one size and a pose for each frame from its first one on, in the LiDAR's frame; its position is the
middle of the box's bottom, its rz the yaw. Labels stand only where the camera looks. Format: the recordings'
development kit, https://www.cvlibs.net/datasets/kitti/raw_data.php
"""

from collections import defaultdict
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from asca_pillars.data.boxes.box_records import records_from
from asca_pillars.data.boxes.box_split import BoxDataset
from asca_pillars.data.importing.imported import Imported, ImportedFrame
from asca_pillars.data.importing.kitti_tracking import LABELED_VIEW_DEG, TYPES
from asca_pillars.data.scans.find_scans import files_below, visible_files
from asca_pillars.errors import DatasetError
from asca_pillars.input_files import read_text

LABELS = "tracklet_labels.xml"


class _Labels(NamedTuple):
    """Of one frame: boxes of 7 numbers, their types and their tracklets' numbers."""

    boxes: list[list[float]]
    types: list[str]
    tracks: list[str]


def read_kitti_raw(root: Path) -> Imported:
    """Every scan of every drive below `root` that has tracklets.

    Raises:
        DatasetError: no drive, or a file that is not of this format.
    """
    drives = sorted(path.parent for path in files_below(root.resolve()) if path.name == LABELS)
    if not drives:
        raise DatasetError(f"{root}: no {LABELS} below; give a folder of KITTI's drives, with their tracklets")
    frames = [frame for drive in drives for frame in _frames(drive)]
    return Imported(BoxDataset(scans=str(root.resolve()), labeled_view_deg=LABELED_VIEW_DEG), frames)


def _frames(drive: Path) -> list[ImportedFrame]:
    labels = _read_tracklets(drive / LABELS)
    frames = []
    for scan in visible_files(drive / "velodyne_points" / "data", "*.bin"):
        own = labels.get(int(scan.stem) if scan.stem.isdecimal() else -1, _Labels([], [], []))
        boxes = np.array(own.boxes, np.float64).reshape(-1, 7)
        frames.append(ImportedFrame(scan, records_from(boxes, own.types, None, own.tracks), drive.name))
    return frames


def _read_tracklets(path: Path) -> dict[int, _Labels]:
    """The labels of each frame."""
    labels: dict[int, _Labels] = defaultdict(lambda: _Labels([], [], []))
    try:
        text = read_text(path, DatasetError, errors="replace")
        if "<!ENTITY" in text:  # an entity may unfold to any size
            raise ValueError("it declares entities")
        tracklets = ElementTree.fromstring(text).findall("tracklets/item")
        for number, tracklet in enumerate(tracklets):
            height, width, length = (float(tracklet.findtext(name, "")) for name in "hwl")
            kind = tracklet.findtext("objectType", "").strip()
            first = int(tracklet.findtext("first_frame", ""))
            if not kind or not min(height, width, length) > 0:
                raise ValueError(f"tracklet {number} has no type or no size")
            for offset, pose in enumerate(tracklet.findall("poses/item")):
                x, y, bottom, yaw = (float(pose.findtext(name, "")) for name in ("tx", "ty", "tz", "rz"))
                if not np.isfinite([x, y, bottom, yaw, height, width, length]).all():
                    raise ValueError(f"tracklet {number} has a number that is not finite")
                own = labels[first + offset]
                own.boxes.append([x, y, bottom + height / 2, length, width, height, yaw])
                own.types.append(TYPES.get(kind, kind))
                own.tracks.append(str(number))
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror}); correct the path") from None
    except (ElementTree.ParseError, ValueError) as error:
        raise DatasetError(f"{path}: no tracklets of KITTI ({error}); download the file again") from None
    return dict(labels)
