"""Labels that lie beside a scan, in KITTI's layout and in a dataset with boxes."""

from pathlib import Path

import numpy as np
import pytest

from asca_pillars.base.errors import DatasetError
from asca_pillars.data.boxes.box_records import json_line, records_from
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.data.open_split import labels_of_scan
from tests.data.boxes.box_scenes import write_box_dataset
from tests.helpers.scenes import write_dataset


def test_kitti(tmp_path: Path) -> None:
    split = KittiSplit(write_dataset(tmp_path / "kitti", 1))
    scan, label = split.scan_path("000000"), split.label_path("000000")
    boxes = labels_of_scan(scan)
    assert boxes is not None and len(boxes)
    np.testing.assert_array_equal(boxes, split.labeled_boxes("000000").boxes)
    label.write_text("damaged")
    with pytest.raises(DatasetError, match=r"000000\.txt:1"):
        labels_of_scan(scan)
    label.unlink()
    assert labels_of_scan(scan) is labels_of_scan(tmp_path / "scan.bin") is None


def test_boxes_are_in_the_frame_of_the_scan(tmp_path: Path) -> None:
    root = write_box_dataset(tmp_path / "own", 2)
    (root / "dataset.yaml").write_text("{axes: y-forward, labels: labels.jsonl}\n")
    box = [[-3, 12, -1, 4, 2, 1.5, 1.2]]
    (root / "labels.jsonl").write_text(json_line("000000.bin", records_from(np.array(box), ["Car"])))
    boxes = labels_of_scan(root / "scans" / "000000.bin")
    assert boxes is not None
    np.testing.assert_allclose(boxes, box, atol=1e-4)
    assert labels_of_scan(root / "scans" / "000001.bin") is None  # without a line
    assert labels_of_scan(tmp_path / "own" / "elsewhere.bin") is None  # not one of its scans
