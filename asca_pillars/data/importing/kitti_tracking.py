"""KITTI's tracking benchmark: velodyne/<sequence>/<frame>.bin, label_02/<sequence>.txt, calib/<sequence>.txt.

A line of a label file is one of the detection benchmark's with the frame and the track's number before it, in the
rectified camera's frame; only the camera's field of view is labelled. Format: the benchmark's development kit,
https://www.cvlibs.net/datasets/kitti/eval_tracking.php
"""

from collections import defaultdict
from pathlib import Path

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.files import read_text
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.data.boxes.box_records import BoxRecords, records_from
from asca_pillars.data.boxes.box_split import BoxDataset
from asca_pillars.data.importing.imported import Imported, ImportedFrame, SkippedEntries
from asca_pillars.data.kitti import Calibration, KittiObject, boxes_from_objects, parse_object, read_calibration
from asca_pillars.scans.find_scans import visible_files

LABELED_VIEW_DEG = 81.0
"""Field of view of KITTI's left color camera: 1242 pixels at a focal length of 721."""
TYPES = {"Person": "Person_sitting", "Person (sitting)": "Person_sitting"}
"""Names in KITTI's tracking and raw recordings that differ in its object benchmark."""
_LONGEST_FRAME = 20  # digits of a frame's number
_Tracked = tuple[KittiObject, str]


def read_kitti_tracking(root: Path, reporter: Reporter = SILENT) -> Imported:
    """Read every scan of every sequence that has labels.

    Args:
        root: the folder that contains training/, or training/ itself.
        reporter: told of each sequence.

    Raises:
        DatasetError: no sequence, or a file that is not of this format.
    """
    folder = root / "training" if (root / "training").is_dir() else root
    labels = visible_files(folder / "label_02", "*.txt")
    if not labels:
        raise DatasetError(f"{folder}: no label_02/*.txt there; give the folder of KITTI's tracking benchmark")
    skipped = SkippedEntries()
    bar = reporter.track(labels, "Reading sequences")
    frames = [frame for path in bar for frame in _frames(folder.resolve(), path, skipped)]
    settings = BoxDataset(scans=str(folder.resolve() / "velodyne"), labeled_view_deg=LABELED_VIEW_DEG)
    return Imported(settings, frames, skipped)


def _frames(folder: Path, labels: Path, skipped: SkippedEntries) -> list[ImportedFrame]:
    sequence = labels.stem
    calibration = read_calibration(folder / "calib" / f"{sequence}.txt")
    tracked = _read_tracked(labels, skipped)
    frames = []
    for scan in visible_files(folder / "velodyne" / sequence, "*.bin"):
        number = int(scan.stem) if scan.stem.isdecimal() else -1
        objects = [(item, track) for item, track in tracked.get(number, []) if item.has_box_3d]
        frames.append(ImportedFrame(scan, _records(objects, calibration), sequence))
    return frames


def _records(tracked: list[_Tracked], calibration: Calibration) -> BoxRecords:
    objects = [item for item, _ in tracked]
    boxes = boxes_from_objects(objects, calibration)
    return records_from(
        boxes, [TYPES.get(item.type, item.type) for item in objects], None, [track for _, track in tracked]
    )


def _read_tracked(path: Path, skipped: SkippedEntries) -> dict[int, list[_Tracked]]:
    """Read the objects of each frame with their track numbers."""
    try:
        lines = read_text(path, DatasetError, errors="replace").splitlines()
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror}); correct the path") from None
    tracked = defaultdict(list)
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words:
            continue
        if len(words) < 2 or not (words[0].isdecimal() and len(words[0]) < _LONGEST_FRAME):
            skipped.add("lines", f"{path}:{number}", "does not begin with a frame's number")
            continue
        try:
            tracked[int(words[0])].append((parse_object(words[2:], f"{path}:{number}"), words[1]))
        except DatasetError as error:
            skipped.add("lines", path, error)
    return dict(tracked)
