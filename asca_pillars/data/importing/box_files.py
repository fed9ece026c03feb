"""Import of CSV or JSON boxes (`data.boxes.box_records`), with their scans in a folder."""

from pathlib import Path

from asca_pillars.base.schema import parse, to_dict
from asca_pillars.data.boxes.box_split import BoxDataset, find_frames
from asca_pillars.data.importing.foreign_values import SkippedEntries
from asca_pillars.data.importing.imported import Imported, ImportedFrame
from asca_pillars.scans.scan_settings import ScanSettings


def read_box_files(labels: Path, scans: Path, settings: ScanSettings) -> Imported:
    """Read every frame of a .jsonl or .csv file, or of a folder with a .json or .csv for each scan.

    Each folder of scans is a recording.

    Args:
        labels: the file or folder.
        scans: folder of the scans.
        settings: settings of the scans; labels are in the scans' own frame.

    Raises:
        ConfigError: the pose cannot be read.
        DatasetError: as `find_frames`.
    """
    dataset = dataset_settings(scans, settings)
    scans = Path(dataset.scans)
    frames = [
        ImportedFrame(frame.scan, frame.records, frame.scan.parent.relative_to(scans).as_posix(), frame.time_s)
        for frame in find_frames(labels, scans).values()
    ]
    return Imported(dataset, frames, SkippedEntries())


def dataset_settings(scans: Path, settings: ScanSettings) -> BoxDataset:
    """Return the settings of a dataset of these scans, by their absolute path.

    Raises:
        ConfigError: the pose cannot be read.
    """
    settings.stated_mounting()
    stated = to_dict(settings) | {"pose": None if settings.pose is None else str(Path(settings.pose).resolve())}
    return parse(BoxDataset, stated | {"scans": str(scans.resolve())}, "import")
