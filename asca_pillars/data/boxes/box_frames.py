"""The frames of a dataset with boxes: each labelled scan, by its id, with the place of its labels."""

from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.files import file_inside, is_hidden
from asca_pillars.data.boxes.box_records import BoxRecords, read_frame_file, read_frames, read_time, records_from
from asca_pillars.scans.find_scans import SCAN_SUFFIXES, files_below, find_scans, visible_files

DATASET_FILE = "dataset.yaml"
_DEEPEST = 64
"""Folders of a path in a label that are looked at."""


class BoxFrame(NamedTuple):
    """A scan and its labels; records and time of a file for all frames, None where the frame has a file of its own."""

    scan: Path
    label_file: Path
    file_records: BoxRecords | None
    file_time_s: float | None = None

    @property
    def records(self) -> BoxRecords:
        """The boxes; DatasetError if the frame's own file is damaged."""
        return read_frame_file(self.label_file) if self.file_records is None else self.file_records

    @property
    def time_s(self) -> float | None:
        """The time stamp that the labels state, if any; DatasetError as `records`."""
        return read_time(self.label_file) if self.file_records is None else self.file_time_s


def find_frames(labels: Path, scans: Path) -> dict[str, BoxFrame]:
    """Every labelled frame by its id.

    Args:
        labels: a .jsonl or .csv file for all frames, or a folder with a .json or .csv for each.
        scans: folder that the scans are below.

    Raises:
        DatasetError: labels that are missing, wrong, given twice, or of a scan that is not there.
    """
    if not scans.is_dir():
        raise DatasetError(f"{scans}: no such folder; give the one that the scans are below as `scans`")
    if labels.is_dir():
        return _frames_of_folder(labels, scans)
    frames: dict[str, BoxFrame] = {}
    places: dict[str, str] = {}
    if labels.suffix.lower() == ".csv":
        nothing = records_from(np.zeros((0, 7)), ())
        for path in find_scans(scans):
            same = frames.setdefault(frame_id_of(path, scans), BoxFrame(path, labels, nothing)).scan
            if same != path:
                raise DatasetError(f"{same} and {path}: both would be frame {frame_id_of(path, scans)}; rename one")
    for scan, records, place, time_s, _ in read_frames(labels):
        found = _find_scan(scan, scans)
        if found is None:
            raise DatasetError(
                f"{place}: no scan {scan[:200]} below {scans}; correct the name, or `scans` in {DATASET_FILE}"
            )
        frame_id = frame_id_of(found, scans)
        if frame_id in places:
            raise DatasetError(f"{place}: {scan} has labels in {places[frame_id]} already; join them")
        frames[frame_id], places[frame_id] = BoxFrame(found, labels, records, time_s), place
    if not frames:
        raise DatasetError(f"{labels}: no frame in it; write a line for each scan, as docs/DATA.md says")
    return frames


def frame_id_of(path: Path, scans: Path) -> str:
    """The id of the frame whose scan is at `path`, below the folder `scans`."""
    return path.relative_to(scans).with_suffix("").as_posix()


def _find_scan(scan: str, scans: Path) -> Path | None:
    """The longest end of the path `scan` that is a file below `scans`: a label may name its scan from elsewhere."""
    parts = PurePosixPath(scan.replace("\\", "/")).parts
    if ".." in parts:
        return None
    ends = ("/".join(parts[first:]) for first in range(max(len(parts) - _DEEPEST, 0), len(parts)))
    return next((path for end in ends if (path := file_inside(scans, end)) is not None), None)


def _is_label(relative: Path) -> bool:
    return relative.suffix.lower() in (".json", ".csv") and not is_hidden(relative)


def _frames_of_folder(labels: Path, scans: Path) -> dict[str, BoxFrame]:
    frames: dict[str, BoxFrame] = {}
    for path in sorted(entry for entry in files_below(labels) if _is_label(entry.relative_to(labels))):
        frame_id = frame_id_of(path, labels)
        there = [scan for suffix in SCAN_SUFFIXES if (scan := scans / f"{frame_id}{suffix}").is_file()]
        if len(there) != 1:
            found = " and ".join(scan.name for scan in there) or "none"
            raise DatasetError(f"{path}: belongs to one scan {scans / frame_id}.*, there is {found}; rename the files")
        if frame_id in frames:
            raise DatasetError(f"{path}: {frames[frame_id].label_file.name} has labels of the scan already; remove one")
        frames[frame_id] = BoxFrame(there[0], path, None)
    if not frames:
        advice = "write one for each scan"
        if texts := visible_files(labels, "*.txt"):
            advice = (
                f"{texts[0].name} is text, as KITTI's or OpenPCDet's labels: write a .csv for each scan, a line of "
                "names (class,x_m,y_m,z_m,length_m,width_m,height_m,yaw_rad) and below it the values, separated by "
                "commas"
            )
        raise DatasetError(f"{labels}: no <frame>.json or <frame>.csv there; {advice}")
    return frames
