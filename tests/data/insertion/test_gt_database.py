"""The object database: what it holds, when it is built, and that nothing half built is ever used."""

import dataclasses
import os
import pickle
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_pillars.base.errors import AscaError, DatasetError
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.frames import read_frame
from asca_pillars.data.insertion import gt_database
from asca_pillars.data.insertion.gt_database import ObjectDatabase, prepare_database
from asca_pillars.data.kitti import KittiObject, KittiSplit, read_labels, write_labels
from asca_pillars.geometry.boxes import points_in_boxes
from tests.data.boxes.box_scenes import write_box_dataset
from tests.data.insertion.simple_streets import TYPES, write_streets


@pytest.fixture
def split(tmp_path: Path) -> KittiSplit:
    return KittiSplit(write_streets(tmp_path / "data", 3), "train")


def prepare(split: KittiSplit, prepared: Path, names: tuple[str, ...] = TYPES, **options: Any) -> ObjectDatabase:
    return prepare_database(split, names, prepared, **{"camera_view": True} | options)


def contents(database: ObjectDatabase) -> list[bytes]:
    return [database.path.with_suffix(suffix).read_bytes() for suffix in (".json", ".npy", ".npz")]


def rename(split: KittiSplit, frame_id: str, index: int, name: str) -> None:
    objects: list[KittiObject] = read_labels(split.label_path(frame_id))
    objects[index] = dataclasses.replace(objects[index], type=name)
    write_labels(split.label_path(frame_id), objects)


def test_it_holds_every_labelled_object_with_its_points(split: KittiSplit, tmp_path: Path) -> None:
    rename(split, "000001", 0, "Van")  # no class, but a neighbor of one: not in it
    rename(split, "000002", 0, "Truck")
    database = prepare(split, tmp_path / "prepared")
    frames = [read_frame(split, frame_id, TYPES, min_points=0) for frame_id in split.frame_ids]
    kept = [(frame, frame.labels >= 0) for frame in frames]
    assert len(database) == 10 and database.point_counts.sum() > 100
    assert np.array_equal(database.boxes, np.concatenate([frame.boxes[mask] for frame, mask in kept]))
    assert np.array_equal(database.labels, np.concatenate([frame.labels[mask] for frame, mask in kept]))
    assert database.frames.tolist() == [0] * 4 + [1] * 3 + [2] * 3
    for index in range(len(database)):
        item, frame = database[index], frames[database.frames[index]]
        own = frame.points[points_in_boxes(frame.points, item.box[None])[:, 0]]
        assert np.array_equal(item.points, own) and item.points.dtype == np.float32
        assert item.label == database.labels[index] and len(own) == database.point_counts[index]
    before = database[0].points.copy()  # what is taken out is a copy
    database[0].points[:] = 0
    database[0].box[:] = 0
    assert np.array_equal(database[0].points, before) and database.boxes[0].any()


def test_it_is_built_once_and_again_when_something_changed(
    split: KittiSplit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    builds = []
    build = gt_database._build
    monkeypatch.setattr(gt_database, "_build", lambda path, *args: (builds.append(path), build(path, *args)))
    first = prepare(split, tmp_path / "prepared")
    assert prepare(split, tmp_path / "prepared").path == first.path and len(builds) == 1
    prepare(split, tmp_path / "prepared", names=("Pedestrian", "Car"))
    prepare(split, tmp_path / "prepared", camera_view=False)
    prepare(KittiSplit(split.root, "val"), tmp_path / "prepared")
    assert len(set(builds)) == len(builds) == 4
    os.utime(split.scan_path("000001"), ns=(1, 1))
    prepare(split, tmp_path / "prepared")
    rename(split, "000001", 0, "Pedestrian")
    assert prepare(split, tmp_path / "prepared").labels.tolist().count(1) == 4
    assert len(set(builds)) == len(builds) == 6
    assert first.labels.tolist().count(1) == 3  # what a run uses stays


def test_other_axes_or_another_pose_make_another(tmp_path: Path) -> None:
    """Scans and labels are the same files, their points and boxes lie elsewhere."""
    root = write_box_dataset(tmp_path / "own", 2)
    pose = np.eye(4)

    def boxes(settings: str) -> NDArray[np.float32]:
        (root / "dataset.yaml").write_text(settings)
        np.savetxt(root / "pose.txt", pose)
        return prepare_database(BoxSplit(root), ("Car",), tmp_path / "prepared", camera_view=False).boxes

    straight, turned = boxes(""), boxes("axes: y-forward")
    assert np.allclose(turned[:, 0], straight[:, 1]) and np.allclose(turned[:, 1], -straight[:, 0])
    posed = boxes("pose: pose.txt")
    pose[2, 3] = 1.5
    assert np.allclose(posed, straight) and np.allclose(boxes("pose: pose.txt")[:, 2], straight[:, 2] + 1.5)
    assert np.array_equal(boxes(""), straight) and len(list((tmp_path / "prepared").rglob("*.json"))) == 4


def test_any_number_of_processes_writes_the_same_everywhere(
    split: KittiSplit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The points are written as they come, and how many they are stands before them, as NumPy has it."""
    monkeypatch.setattr(gt_database, "_AT_ONCE", 1)  # three frames are too few for two processes otherwise
    alone, other = prepare(split, tmp_path / "alone"), prepare(split, tmp_path / "other")
    monkeypatch.setattr(gt_database, "read_frame", lambda *_, **__: pytest.fail("read in this process"))
    shared = prepare(split, tmp_path / "shared", workers=2)
    assert alone.path.name == other.path.name == shared.path.name
    assert contents(alone) == contents(other) == contents(shared)
    np.save(tmp_path / "again.npy", np.load(alone.path.with_suffix(".npy")))
    assert contents(alone)[1] == (tmp_path / "again.npy").read_bytes()


@pytest.mark.parametrize("workers", [1, 2])
def test_a_build_that_fails_leaves_nothing_to_be_used(
    split: KittiSplit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, workers: int
) -> None:
    monkeypatch.setattr(gt_database, "_AT_ONCE", 1)
    text = split.label_path("000002").read_text()
    split.label_path("000002").write_text("Car 1 2\n")
    with pytest.raises(DatasetError, match="000002"):
        prepare(split, tmp_path / "prepared", workers=workers)
    assert not [path for name in ("*.n*", "*.json", ".*") for path in (tmp_path / "prepared").rglob(name)]
    split.label_path("000002").write_text(text)
    assert len(prepare(split, tmp_path / "prepared")) == 12


def test_builders_at_the_same_time_do_not_meet(split: KittiSplit, tmp_path: Path) -> None:
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: prepare(split, tmp_path / "prepared")[5], range(4)))
    for item in found[1:]:
        assert np.array_equal(item.points, found[0].points) and np.array_equal(item.box, found[0].box)
    assert not list(tmp_path.rglob(".*"))


def test_what_goes_to_a_worker_is_the_path_of_what_must_be_there(split: KittiSplit, tmp_path: Path) -> None:
    database = prepare(split, tmp_path / "prepared")
    box = database[3].box
    assert len(pickle.dumps(database)) < 1000
    rebuild, arguments = database.__reduce__()  # what the other process does with it
    assert np.array_equal(rebuild(*arguments)[3].box, box)
    prepare(split, tmp_path / "prepared")
    split.scan_path("000001").unlink()
    with pytest.raises(AscaError, match=r"000001\.bin"):
        prepare(split, tmp_path / "prepared")


def test_a_folder_that_cannot_be_written_is_named_before_the_work(
    split: KittiSplit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setattr(gt_database, "read_frame", lambda *_, **__: pytest.fail("read"))
    with pytest.raises(DatasetError, match=r"file/prepared/.*: cannot be written.*data\.prepared") as caught:
        prepare(split, tmp_path / "file" / "prepared")
    assert "\n" not in str(caught.value)


def test_frames_without_objects(split: KittiSplit, tmp_path: Path) -> None:
    for frame_id in split.frame_ids:
        split.label_path(frame_id).write_text("")
    database = prepare(split, tmp_path / "prepared")
    assert len(database) == 0 and database.boxes.shape == (0, 7) and database.point_counts.shape == (0,)
