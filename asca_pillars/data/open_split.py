"""Opening of datasets by the layout of their folder, and search for the labels of a single scan."""

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.boxes.box_split import DATASET_FILE, BoxSplit, frame_id_of
from asca_pillars.data.frames import LabeledSplit
from asca_pillars.data.kitti import KittiSplit, boxes_from_objects, objects_3d, read_calibration, read_labels


def open_split(root: str | Path, name: str = "training") -> LabeledSplit:
    """Open a dataset: of the box layout if `root` contains a dataset.yaml, else of KITTI's.

    Args:
        root: the dataset's folder.
        name: a list in ImageSets/, or "training" for every frame.

    Raises:
        ConfigError: dataset.yaml is invalid.
    """
    return BoxSplit(root, name) if (Path(root) / DATASET_FILE).is_file() else KittiSplit(root, name)


DEPTH = 6  # folders above a scan that are searched for a dataset.yaml


def labels_of_scan(scan: Path) -> NDArray[np.float32] | None:
    """Return labelled boxes (M, 7) in the scan's own frame, metres and radians; None if there are no labels.

    Labels are read from ../label_2 and ../calib of a scan in a folder velodyne/, or by a dataset.yaml above the scan.

    Raises:
        DatasetError, ConfigError: there are labels, but they are damaged.
    """
    if scan.parent.name == "velodyne":
        label, calib = (scan.parent.parent / name / f"{scan.stem}.txt" for name in ("label_2", "calib"))
        if label.is_file() and calib.is_file():
            return boxes_from_objects(objects_3d(read_labels(label)), read_calibration(calib))
    scan = scan.resolve()
    for folder in scan.parents[:DEPTH]:
        if not (folder / DATASET_FILE).is_file():
            continue
        split = _split(folder)
        scans = split.scans_folder.resolve()
        frame_id = frame_id_of(scan, scans) if scan.is_relative_to(scans) else ""
        return split.records(frame_id).boxes if frame_id in split.frame_ids else None
    return None


@lru_cache(maxsize=1)
def _split(root: Path) -> BoxSplit:
    """Open the dataset once for the scans of a folder."""
    return BoxSplit(root)
