"""KITTI's raw recordings: <date>/<drive>_sync/tracklet_labels.xml and velodyne_points/data/<frame>.bin.

A tracklet has one size and a pose for each frame from its first one on, in the LiDAR's frame; its position is the
middle of the box's bottom, its rz the yaw. Only the camera's field of view is labelled. Format: the recordings'
development kit, https://www.cvlibs.net/datasets/kitti/raw_data.php
"""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.files import read_text
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.data.boxes.box_records import records_from
from asca_pillars.data.boxes.box_split import BoxDataset
from asca_pillars.data.importing.imported import Imported, ImportedFrame, SkippedEntries, numbers, text_of
from asca_pillars.data.importing.kitti_tracking import LABELED_VIEW_DEG, TYPES
from asca_pillars.scans.find_scans import files_below, visible_files

LABELS = "tracklet_labels.xml"
_DOCTYPE = "<!DOCTYPE boost_serialization>"
"""Document type of KITTI's own files."""


class _Labels(NamedTuple):
    """Boxes of 7 numbers, types and track numbers of one frame."""

    boxes: list[list[float]]
    types: list[str]
    tracks: list[str]


def read_kitti_raw(root: Path, reporter: Reporter = SILENT) -> Imported:
    """Read every scan of every drive below `root` that has tracklets.

    Raises:
        DatasetError: no drive, or a file that is not of this format.
    """
    drives = sorted(path.parent for path in files_below(root.resolve()) if path.name == LABELS)
    if not drives:
        raise DatasetError(f"{root}: no {LABELS} below; give a folder of KITTI's drives, with their tracklets")
    skipped = SkippedEntries()
    frames = [frame for drive in reporter.track(drives, "Reading drives") for frame in _frames(drive, skipped)]
    return Imported(BoxDataset(scans=str(root.resolve()), labeled_view_deg=LABELED_VIEW_DEG), frames, skipped)


def _frames(drive: Path, skipped: SkippedEntries) -> list[ImportedFrame]:
    labels = _read_tracklets(drive / LABELS, skipped)
    frames = []
    for scan in visible_files(drive / "velodyne_points" / "data", "*.bin"):
        frame_labels = labels.get(int(scan.stem) if scan.stem.isdecimal() else -1, _Labels([], [], []))
        boxes = np.array(frame_labels.boxes, np.float64).reshape(-1, 7)
        frames.append(
            ImportedFrame(scan, records_from(boxes, frame_labels.types, None, frame_labels.tracks), drive.name)
        )
    return frames


def _read_tracklets(path: Path, skipped: SkippedEntries) -> dict[int, _Labels]:
    """Read the labels of each frame."""
    labels: dict[int, _Labels] = defaultdict(lambda: _Labels([], [], []))
    try:
        text = read_text(path, DatasetError, errors="replace")
        if "<!DOCTYPE" in text.replace(_DOCTYPE, "", 1):  # entities of a document type may expand to any size
            raise ValueError(f"another DOCTYPE than {_DOCTYPE}")
        tracklets = ElementTree.fromstring(text).findall("tracklets/item")
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror}); correct the path") from None
    except (ElementTree.ParseError, ValueError) as error:
        raise DatasetError(f"{path}: not a KITTI tracklet file ({error}); download the file again") from None
    for number, tracklet in enumerate(tracklets):
        try:
            _add(labels, number, tracklet, skipped, path)
        except ValueError as reason:
            skipped.add("tracklets", f"{path}, tracklet {number}", reason)
    return dict(labels)


def _add(
    labels: dict[int, _Labels], number: int, tracklet: ElementTree.Element, skipped: SkippedEntries, path: Path
) -> None:
    """Add the boxes of a tracklet to their frames; ValueError if it has no type, size or first frame."""
    height, width, length = _numbers(tracklet, "hwl")
    kind = text_of(tracklet.findtext("objectType", ""), "objectType")
    if not min(height, width, length) > 0:
        raise ValueError(f"no size ({height:g}, {width:g}, {length:g})")
    first = int(tracklet.findtext("first_frame", ""))
    for offset, pose in enumerate(tracklet.findall("poses/item")):
        try:
            x, y, bottom, yaw = _numbers(pose, ("tx", "ty", "tz", "rz"))
        except ValueError as reason:
            skipped.add("boxes", f"{path}, tracklet {number}, pose {offset}", reason)
            continue
        frame_labels = labels[first + offset]
        frame_labels.boxes.append([x, y, bottom + height / 2, length, width, height, yaw])
        frame_labels.types.append(TYPES.get(kind, kind))
        frame_labels.tracks.append(str(number))


def _numbers(element: ElementTree.Element, names: Sequence[str]) -> list[float]:
    stated = [float(element.findtext(name, "")) for name in names]
    values: list[float] = numbers(stated, len(names), ", ".join(names)).tolist()
    return values
