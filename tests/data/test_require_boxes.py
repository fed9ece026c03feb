"""A list without a box that can be learnt is refused before the training, and a class without boxes is named."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from asca_pillars.base.errors import DatasetError
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import Config, DataConfig, InsertConfig
from asca_pillars.data.insertion.insert_objects import prepare_inserter
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.scans.scan_reader import write_scan
from asca_pillars.training.dataset import require_boxes
from asca_pillars.training.loop import train
from tests.helpers.scenes import SPEC, write_dataset

CONFIG = Config(model=PillarModel(spec=SPEC), data=DataConfig(workers=0))


def rewritten(root: Path, change: Callable[[str], str], frames: int = 4) -> Path:
    """A dataset of these frames, the last one for validation, with the text of every label file changed."""
    write_dataset(root, frames)
    for path in (root / "training" / "label_2").glob("*.txt"):
        path.write_text(change(path.read_text()))
    return root


def test_right_labels_pass_and_boxes_without_points_do_not(tmp_path: Path) -> None:
    root = rewritten(tmp_path, str)
    for name, training in (("train", True), ("val", False)):
        assert require_boxes(KittiSplit(root, name), CONFIG, training=training) == []
    root = rewritten(tmp_path, str)
    for path in (root / "training" / "velodyne").glob("*.bin"):
        write_scan(path, np.array([[5.0, 0.0, 5.0, 0.1]], np.float32))
    with pytest.raises(DatasetError, match=r"none of the boxes in 3 frames has data\.min_points = 1 points"):
        require_boxes(KittiSplit(root, "train"), CONFIG, training=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (str.lower, r"the labels spell them 'car', 'pedestrian', 'cyclist'.* model\.spec\.classes"),
        (lambda _: "", "none at all"),
        (lambda text: re.sub(r"(?m)^\w+ ", "Lorry ", text), r"Lorry \d+"),
        # 300 m ahead; the 14th word is z of the camera.
        (lambda text: re.sub(r"(?m)^((\S+ ){13})\S+", r"\g<1>300.00", text), r"lie outside .*model\.spec\.grid"),
    ],
)
def test_no_box_of_any_class(change: Callable[[str], str], message: str, tmp_path: Path) -> None:
    root = rewritten(tmp_path / "data", change)
    with pytest.raises(DatasetError, match=f"list `train` has no box of Car, Pedestrian, Cyclist: .*{message}"):
        train(CONFIG, root, tmp_path / "run")
    assert not list((tmp_path / "run").glob("*")), "nothing was begun"


def test_a_class_without_boxes_is_named(tmp_path: Path) -> None:
    root = rewritten(tmp_path / "without", lambda text: re.sub(r"(?m)^Cyclist .*\n", "", text))
    for name, training, cannot in (("train", True, "learnt"), ("val", False, "recall cannot be measured")):
        (line,) = require_boxes(KittiSplit(root, name), CONFIG, training=training)
        assert f"`{name}` has no box of Cyclist" in line and cannot in line and "Pedestrian" in line
    split = KittiSplit(rewritten(tmp_path / "other", lambda text: text.replace("Cyclist", "cy-clist")), "train")
    (line,) = require_boxes(split, CONFIG, training=True)
    assert "the labels spell it 'cy-clist'" in line
    with pytest.raises(DatasetError, match="no Cyclist with a point in it; the labels spell it 'cy-clist'"):
        prepare_inserter(split, SPEC, CONFIG.data, InsertConfig(method="gt_aug"))


def test_validation_without_boxes_can_go_on_unless_its_names_differ(tmp_path: Path) -> None:
    root = rewritten(tmp_path, str)
    label = root / "training" / "label_2" / "000003.txt"
    text = label.read_text()
    label.write_text("")
    (line,) = require_boxes(KittiSplit(root, "val"), CONFIG, training=False)
    assert "recall cannot be measured" in line
    label.write_text(text.upper())
    with pytest.raises(DatasetError, match=r"list `val` has no box of .* spell them 'CAR'"):
        require_boxes(KittiSplit(root, "val"), CONFIG, training=False)
