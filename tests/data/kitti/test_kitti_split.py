"""The folder layout, and real frames where there are some."""

import hashlib
import json
import math
import os
import struct
from pathlib import Path

import numpy as np
import pytest

from asca_pillars.base.errors import DatasetError, OutputError, ScanError
from asca_pillars.data.kitti import (
    DEFAULT_IMAGE_SIZE_WH,
    KittiSplit,
    boxes_from_objects,
    in_image,
    objects_3d,
    objects_from_boxes,
    write_image_set,
    write_labels,
)
from asca_pillars.data.kitti.kitti_split import train_val_frames, write_train_val_lists
from asca_pillars.scans.scan_reader import read_scan
from tests.helpers.cameras import assert_one_line
from tests.helpers.in_process import invoke

BOX_FIELDS = ("height_m", "width_m", "length_m", "x_m", "y_m", "z_m", "rotation_y")


@pytest.fixture
def root(tmp_path):
    for folder, frame_ids in (("training", ["000010", "000002", "000001"]), ("testing", ["000007"])):
        (tmp_path / folder / "velodyne").mkdir(parents=True)
        for frame_id in frame_ids:
            (tmp_path / folder / "velodyne" / f"{frame_id}.bin").write_bytes(bytes(16))
    return tmp_path


def test_splits(root):
    """Hidden files are of a killed writer, or of macOS; Notepad begins a list with a byte-order mark."""
    for name in (".000001.asca-12345678.bin", "._000002.bin"):
        (root / "training/velodyne" / name).write_bytes(bytes(16))
    write_image_set(root, "val", ["000010", "000001"])
    write_image_set(root, "test", ["000007"])
    assert KittiSplit(root).frame_ids == ("000001", "000002", "000010")
    assert KittiSplit(str(root), "val").frame_ids == ("000001", "000010")
    assert KittiSplit(root, "testing").frame_ids == KittiSplit(root, "test").frame_ids == ("000007",)
    assert KittiSplit(root, "val").scan_path("000010") == root / "training/velodyne/000010.bin"
    assert KittiSplit(root, "test").calib_path("000007") == root / "testing/calib/000007.txt"
    (root / "ImageSets/val.txt").write_text("000001\n", encoding="utf-8-sig")
    assert KittiSplit(root, "val").frame_ids == ("000001",)


def test_missing_parts_of_a_dataset_are_named(root):
    split, nowhere = KittiSplit(root), root / "nowhere"
    write_image_set(root, "val", ["000001", "000003", "000004"])
    for name, content in (("none", b""), ("bytes", b"000001\n\xff\xfe\n")):
        (root / "ImageSets" / f"{name}.txt").write_bytes(content)
    for place, words, action in (
        (root / "training/label_2/000001.txt", ["empty file"], lambda: split.objects("000001")),
        (root / "training/calib/000001.txt", ["calib"], lambda: split.calibration("000001")),
        (root / "training/velodyne/000003.bin", ["2 of 3", "val.txt"], lambda: KittiSplit(root, "val").frame_ids),
        ("none.txt", ["empty"], lambda: KittiSplit(root, "none").frame_ids),
        ("bytes.txt", ["not UTF-8"], lambda: KittiSplit(root, "bytes").frame_ids),
        ("vall.txt", ["bytes, none, val", "--split training"], lambda: KittiSplit(root, "vall").frame_ids),
        (nowhere / "training/velodyne", ["<root>"], lambda: KittiSplit(nowhere).frame_ids),
    ):
        assert_one_line(place, words, action)


def test_scans_of_five_columns_and_labels_that_stand_all_around(root) -> None:
    """With the number of the beam after the reflectance; 5 points are no whole number of points of four columns."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-20, 20, (5, 3)), rng.random(5)]).astype("<f4")
    split = KittiSplit(root)
    np.column_stack([points, np.arange(5)]).astype("<f4").tofile(split.scan_path("000001"))
    np.testing.assert_array_equal(split.stored_points("000001"), points)
    np.testing.assert_array_equal(split.points("000001", camera_view=False), points)
    assert KittiSplit(root).has_camera
    for view, camera in (("around", False), ("full", True), ("camera", True)):
        (root / "simulation.json").write_text(json.dumps({"seed": 1, "field_of_view": view}))
        assert KittiSplit(root).has_camera is camera
    (root / "simulation.json").write_text("{")
    with pytest.raises(DatasetError, match=r"simulation\.json"):
        _ = KittiSplit(root).has_camera


def test_image_size_is_read_from_the_png_or_assumed(root):
    split = KittiSplit(root)
    assert split.image_size_wh("000001") == DEFAULT_IMAGE_SIZE_WH
    split.image_path("000001").parent.mkdir()
    start = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + b"IHDR" + struct.pack(">2I", 1224, 370)
    split.image_path("000001").write_bytes(start + bytes(9))
    assert split.image_size_wh("000001") == (1224, 370)
    for damaged in (b"", start[:20], b"\xff\xd8\xff\xe0" + bytes(40), start[:16] + bytes(8)):
        split.image_path("000001").write_bytes(damaged)
        assert_one_line(split.image_path("000001"), ["not a PNG"], lambda: split.image_size_wh("000001"))


# --- real frames, where there are some


@pytest.fixture
def kitti_mini():
    folder = os.environ.get("ASCA_KITTI_MINI")
    if not folder:
        pytest.skip("ASCA_KITTI_MINI does not name a folder with real KITTI frames")
    return KittiSplit(folder)


def test_real_labels_survive_the_round_trip_and_scans_are_read_whole(kitti_mini, tmp_path) -> None:
    for frame_id in kitti_mini.frame_ids:
        calib, labels = kitti_mini.calibration(frame_id), kitti_mini.objects(frame_id)
        write_labels(tmp_path / "again.txt", labels)
        assert (tmp_path / "again.txt").read_text() == kitti_mini.label_path(frame_id).read_text().strip() + "\n"
        objects = objects_3d(labels)
        types, size = [o.type for o in objects], kitti_mini.image_size_wh(frame_id)
        boxes = boxes_from_objects(objects, calib)
        for before, after in zip(objects, objects_from_boxes(boxes, types, calib, size), strict=True):
            for name in BOX_FIELDS:
                assert f"{getattr(after, name):z.2f}" == f"{getattr(before, name):z.2f}", (frame_id, name)
            if before.type != "Pedestrian":  # their arms and legs leave the box
                np.testing.assert_allclose(after.bbox, before.bbox, atol=2.0)
                assert abs(math.remainder(after.alpha - before.alpha, 2 * math.pi)) < 0.05
    frame_id = kitti_mini.frame_ids[0]
    scan = read_scan(kitti_mini.scan_path(frame_id))
    assert len(scan.points) > 100_000
    assert scan.dropped_points == 0
    assert 0.5 < scan.points[:, 3].max() <= 1
    seen = in_image(scan.points, kitti_mini.calibration(frame_id), kitti_mini.image_size_wh(frame_id))
    assert 0.1 < seen.mean() < 0.25


# --- KITTI's two lists: as the toolboxes carry them, to the last byte


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


def test_lists_of_ones_own_stay_and_other_frames_are_refused(kitti: Path) -> None:
    folder = kitti / "training" / "velodyne"
    for old, new, message in (("000007", ".000007", "7480 of KITTI's 7481"), ("000007", "007481", "and 1 others")):
        (folder / f"{old}.bin").rename(folder / f"{new}.bin")
        with pytest.raises(DatasetError, match=message):
            write_train_val_lists(kitti)
        (folder / f"{new}.bin").rename(folder / f"{old}.bin")
    assert not (kitti / "ImageSets").exists()
    write_image_set(kitti, "val", ["000001"])
    with pytest.raises(OutputError, match=r"val\.txt: lists other frames"):
        write_train_val_lists(kitti)
    assert [path.name for path in (kitti / "ImageSets").iterdir()] == ["val.txt"]
    assert KittiSplit(kitti, "val").frame_ids == ("000001",)


def test_asca_prepare_writes_them_first(kitti: Path) -> None:
    with pytest.raises(ScanError, match="is empty"):
        invoke("prepare", "asca_pointpillars_kitti", "--data", kitti, "--kitti-split")
    assert {path.name for path in (kitti / "ImageSets").iterdir()} == {"train.txt", "val.txt"}
