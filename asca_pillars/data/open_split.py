"""A dataset's list, by the layout of its folder."""

from pathlib import Path

from asca_pillars.data.boxes.box_frames import DATASET_FILE
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.data.labeled_split import LabeledSplit


def open_split(root: str | Path, name: str = "training") -> LabeledSplit:
    """The layout of boxes if `root` holds a dataset.yaml, else KITTI's.

    Args:
        root: the dataset's folder.
        name: a list in ImageSets/, or "training" for every frame.

    Raises:
        ConfigError: dataset.yaml cannot be used.
    """
    return BoxSplit(root, name) if (Path(root) / DATASET_FILE).is_file() else KittiSplit(root, name)
