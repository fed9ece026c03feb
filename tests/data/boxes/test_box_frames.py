"""Which scans are frames, and what is said of labels without one."""

from pathlib import Path

import numpy as np
import pytest

from asca_pillars.base.errors import DatasetError
from asca_pillars.data.boxes.box_split import BoxSplit


def test_a_file_for_each_frame_gives_the_same(root: Path) -> None:
    lines = (root / "labels.jsonl").read_text().splitlines()
    (root / "labels").mkdir()
    for number, line in enumerate(lines):
        (root / "labels" / f"{number:06d}.json").write_text(line)
    (root / "dataset.yaml").write_text("labels: labels\n")
    split = BoxSplit(root)
    assert split.frame_ids == tuple(f"{number:06d}" for number in range(4))
    (root / "dataset.yaml").write_text("labels: labels.jsonl\n")
    for frame_id in split.frame_ids:
        assert np.array_equal(split.labeled_boxes(frame_id).boxes, BoxSplit(root).labeled_boxes(frame_id).boxes)


def test_with_a_csv_scans_without_a_row_are_frames_without_objects(root: Path) -> None:
    (root / "labels.csv").write_text("scan,class,x,y,z,length,width,height,yaw\n000002.bin,Car,10,0,-1,4,2,1.5,0\n")
    (root / "dataset.yaml").write_text("labels: labels.csv\n")
    split = BoxSplit(root, "train")
    assert [len(split.labeled_boxes(frame_id).boxes) for frame_id in split.frame_ids] == [0, 0, 1]


def test_scans_that_are_no_folder_or_of_one_name_are_named(root: Path) -> None:
    (root / "labels.csv").write_text("scan,class,x,y,z,length,width,height,yaw\n000002.bin,Car,10,0,-1,4,2,1.5,0\n")
    (root / "dataset.yaml").write_text("labels: labels.csv\nscans: scans/000000.bin\n")
    with pytest.raises(DatasetError, match=r"000000\.bin: no such folder"):
        BoxSplit(root).frame_ids  # noqa: B018
    (root / "dataset.yaml").write_text("labels: labels.csv\n")
    np.save(root / "scans" / "000001.npy", np.zeros((5, 4), np.float32))
    with pytest.raises(DatasetError, match=r"000001\.bin and .*000001\.npy: both would be frame 000001; rename one"):
        BoxSplit(root).frame_ids  # noqa: B018


def test_a_line_may_name_its_scan_from_elsewhere(root: Path) -> None:
    labels = root / "labels.jsonl"
    labels.write_text(labels.read_text().replace('"scan": "', f'"scan": "{root}/scans/'))
    assert len(BoxSplit(root).frame_ids) == 4


def test_scans_may_lie_anywhere_and_in_folders(root: Path, tmp_path: Path) -> None:
    (tmp_path / "drive" / "a").mkdir(parents=True)
    for path in (root / "scans").iterdir():
        path.rename(tmp_path / "drive" / "a" / path.name)
    labels = root / "labels.jsonl"
    labels.write_text(labels.read_text().replace('"scan": "', '"scan": "a/'))
    (root / "dataset.yaml").write_text(f"scans: {tmp_path / 'drive'}\n")
    split = BoxSplit(root)
    assert split.frame_ids[0] == "a/000000" and len(split.points("a/000000")) > 1000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"scan": "9.bin", "boxes": []}', r"labels\.jsonl:1: no scan 9\.bin below .*correct the name"),
        ('{"scan": "../000000.bin", "boxes": []}', r"labels\.jsonl:1: no scan"),
        ('{"scan": "000000.bin", "boxes": []}\n' * 2, r"labels\.jsonl:2: 000000\.bin has labels in .*jsonl:1 already"),
        ("", r"labels\.jsonl: no frame in it"),
        ('{"scan": "000000.bin", "boxes": []}', r"000001: listed in ImageSets/train\.txt, but .* has no such frame"),
    ],
)
def test_wrong_labels_are_named(root: Path, text: str, message: str) -> None:
    (root / "labels.jsonl").write_text(text)
    with pytest.raises(DatasetError, match=message):
        BoxSplit(root, "train").frame_ids  # noqa: B018


def test_per_frame_labels_need_their_scan(root: Path) -> None:
    (root / "labels").mkdir()
    (root / "labels" / "9.json").write_text('{"boxes": []}')
    (root / "dataset.yaml").write_text("labels: labels\n")
    with pytest.raises(DatasetError, match=r"9\.json: belongs to one scan .* there is none"):
        BoxSplit(root).frame_ids  # noqa: B018


def test_a_folder_of_text_names_what_to_write(root: Path) -> None:
    (root / "labels").mkdir()
    (root / "labels" / "000000.txt").write_text("10.0 1.0 -1.0 4.1 1.7 1.5 1.2 Car\n")
    (root / "dataset.yaml").write_text("labels: labels\n")
    with pytest.raises(DatasetError, match=r"000000\.txt is text: .*--from openpcdet"):
        BoxSplit(root).frame_ids  # noqa: B018


def test_a_path_of_very_many_folders_is_no_scan(root: Path) -> None:
    (root / "labels.jsonl").write_text(f'{{"scan": "{"a/" * 200_000}x.bin", "boxes": []}}')
    with pytest.raises(DatasetError, match=r"labels\.jsonl:1: no scan"):
        BoxSplit(root).frame_ids  # noqa: B018
