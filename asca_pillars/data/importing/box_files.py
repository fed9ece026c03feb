"""Boxes in CSV or JSON of one's own (`data.boxes.box_records`), with their scans in a folder."""

from pathlib import Path

from asca_pillars.data.boxes.box_split import BoxDataset, find_frames
from asca_pillars.data.importing.imported import Imported, ImportedFrame


def read_box_files(labels: Path, scans: Path) -> Imported:
    """Every frame of a .jsonl or .csv file, or of a folder with a .json or .csv for each scan.

    A recording is a folder of scans.

    Raises:
        DatasetError: as `find_frames`.
    """
    scans = scans.resolve()
    frames = [
        ImportedFrame(frame.scan, frame.records, frame.scan.parent.relative_to(scans).as_posix())
        for frame in find_frames(labels, scans).values()
    ]
    return Imported(BoxDataset(scans=str(scans)), frames)
