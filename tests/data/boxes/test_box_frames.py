"""Which scans are frames, and what is said of labels without one."""

from pathlib import Path

import numpy as np
import pytest

from asca_pillars.base.errors import DatasetError
from asca_pillars.data.boxes.box_split import BoxSplit


def frame_ids(root: Path, settings: str | None = None, name: str = "training") -> tuple[str, ...]:
    if settings is not None:
        (root / "dataset.yaml").write_text(settings)
    return BoxSplit(root, name).frame_ids


def test_a_file_for_each_frame_gives_the_same(root: Path) -> None:
    expected = [BoxSplit(root).labeled_boxes(frame_id).boxes for frame_id in frame_ids(root)]
    (root / "labels").mkdir()
    for number, line in enumerate((root / "labels.jsonl").read_text().splitlines()):
        (root / "labels" / f"{number:06d}.json").write_text(line)
    (root / "labels.jsonl").unlink()
    assert frame_ids(root, "labels: labels\n") == tuple(f"{number:06d}" for number in range(4))
    np.testing.assert_array_equal([BoxSplit(root).labeled_boxes(name).boxes for name in frame_ids(root)], expected)


def test_with_a_csv_scans_without_a_row_are_frames_without_objects(root: Path) -> None:
    (root / "labels.csv").write_text("scan,class,x,y,z,length,width,height,yaw\n000002.bin,Car,10,0,-1,4,2,1.5,0\n")
    names = frame_ids(root, "labels: labels.csv\n", "train")
    assert [len(BoxSplit(root).labeled_boxes(frame_id).boxes) for frame_id in names] == [0, 0, 1]
    with pytest.raises(DatasetError, match=r"000000\.bin: no such folder"):
        frame_ids(root, "labels: labels.csv\nscans: scans/000000.bin\n")
    np.save(root / "scans" / "000001.npy", np.zeros((5, 4), np.float32))
    with pytest.raises(DatasetError, match=r"000001\.bin and .*000001\.npy: both would be frame 000001; rename one"):
        frame_ids(root, "labels: labels.csv\n")


def test_scans_may_lie_anywhere_and_in_folders(root: Path, tmp_path: Path) -> None:
    labels = root / "labels.jsonl"
    text = labels.read_text()
    labels.write_text(text.replace('"scan": "', f'"scan": "{root}/scans/'))
    assert len(frame_ids(root)) == 4
    (tmp_path / "drive").mkdir()
    (root / "scans").rename(tmp_path / "drive" / "a")
    labels.write_text(text.replace('"scan": "', '"scan": "a/'))
    assert frame_ids(root, f"scans: {tmp_path / 'drive'}\n")[0] == "a/000000"
    assert len(BoxSplit(root).points("a/000000")) > 1000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"scan": "9.bin", "boxes": []}', r"labels\.jsonl:1: no scan 9\.bin below .*correct the name"),
        ('{"scan": "../000000.bin", "boxes": []}', r"labels\.jsonl:1: no scan"),
        (f'{{"scan": "{"a/" * 200_000}x.bin", "boxes": []}}', r"labels\.jsonl:1: no scan"),
        ('{"scan": "000000.bin", "boxes": []}\n' * 2, r"labels\.jsonl:2: 000000\.bin has labels in .*jsonl:1 already"),
        ("", r"labels\.jsonl: no frame in it"),
        ('{"scan": "000000.bin", "boxes": []}', r"000001: listed in ImageSets/train\.txt, but .* has no such frame"),
    ],
    ids=range(6),
)
def test_wrong_labels_are_named(root: Path, text: str, message: str) -> None:
    (root / "labels.jsonl").write_text(text)
    with pytest.raises(DatasetError, match=message):
        frame_ids(root, name="train")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("9.json", '{"boxes": []}', r"9\.json: belongs to one scan .* there is none"),
        ("000000.txt", "10.0 1.0 -1.0 4.1 1.7 1.5 1.2 Car\n", r"000000\.txt is text: .*--from openpcdet"),
    ],
)
def test_a_wrong_file_of_labels_is_named(root: Path, name: str, text: str, message: str) -> None:
    (root / "labels").mkdir()
    (root / "labels" / name).write_text(text)
    with pytest.raises(DatasetError, match=message):
        frame_ids(root, "labels: labels\n")
