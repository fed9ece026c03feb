"""KITTI's two lists: as the toolboxes carry them, to the last byte, and written without loss of lists of one's own."""

import hashlib
from pathlib import Path

import pytest

from asca_pillars.base.errors import DatasetError, OutputError, ScanError
from asca_pillars.data.kitti import KittiSplit, write_image_set
from asca_pillars.data.kitti.kitti_split import train_val_frames, write_train_val_lists
from tests.helpers.in_process import invoke

# SHA-256 of OpenPCDet's data/kitti/ImageSets/train.txt and val.txt.
DIGESTS = {
    "train": "e85ce0142be11c7e4196fd7b79a8bc8c2cefdd6fe754ac61fef8d421e37aba5c",
    "val": "6e2394d97c866c3af1ffb049f828abdf3d5b707d9575d16885fd0de87b72b0c8",
}


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kitti") / "velodyne"
    folder.mkdir()
    for number in range(7481):
        (folder / f"{number:06d}.bin").touch()
    return folder


@pytest.fixture
def kitti(frames: Path, tmp_path: Path) -> Path:
    (tmp_path / "training").symlink_to(frames.parent)
    return tmp_path


def test_the_lists_are_the_published_ones(kitti: Path) -> None:
    lists = train_val_frames()
    assert [len(lists[name]) for name in ("train", "val")] == [3712, 3769]
    assert sorted(lists["train"] + lists["val"]) == [f"{number:06d}" for number in range(7481)]
    written = write_train_val_lists(kitti)
    assert {path.stem: hashlib.sha256(path.read_bytes()).hexdigest() for path in written} == DIGESTS
    assert KittiSplit(kitti, "val").frame_ids == tuple(lists["val"])
    assert write_train_val_lists(kitti) == [], "they are there"


def test_lists_of_ones_own_stay(kitti: Path) -> None:
    write_image_set(kitti, "val", ["000001"])
    with pytest.raises(OutputError, match=r"val\.txt: lists other frames"):
        write_train_val_lists(kitti)
    assert [path.name for path in (kitti / "ImageSets").iterdir()] == ["val.txt"]
    assert KittiSplit(kitti, "val").frame_ids == ("000001",)


def test_other_frames_than_kittis_are_refused(kitti: Path) -> None:
    folder = kitti / "training" / "velodyne"
    for old, new, message in (("000007", ".000007", "7480 of KITTI's 7481"), ("000007", "007481", "and 1 others")):
        (folder / f"{old}.bin").rename(folder / f"{new}.bin")
        with pytest.raises(DatasetError, match=message):
            write_train_val_lists(kitti)
        (folder / f"{new}.bin").rename(folder / f"{old}.bin")
    assert not (kitti / "ImageSets").exists()


def test_asca_prepare_writes_them_first(kitti: Path) -> None:
    with pytest.raises(ScanError, match="is empty"):
        invoke("prepare", "asca_pointpillars_kitti", "--data", kitti, "--kitti-split")
    assert {path.name for path in (kitti / "ImageSets").iterdir()} == {"train.txt", "val.txt"}
