"""Imports of small datasets in their published formats, made here."""

import contextlib
import json
import re
from pathlib import Path

import numpy as np
import pytest

from asca_pillars.base.errors import AscaError, ConfigError, DatasetError, OutputError, ScanError
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.importing.imported import drop_unwritable
from asca_pillars.data.importing.nuscenes import read_nuscenes
from asca_pillars.geometry.boxes import points_in_boxes
from asca_pillars.scans.find_scans import find_scans
from asca_pillars.scans.scan_reader import read_scan
from tests.data.boxes.box_scenes import write_box_dataset
from tests.data.importing.foreign_datasets import (
    POSE,
    in_sensor,
    quaternion,
    write_argoverse2,
    write_nuscenes,
)
from tests.helpers.in_process import invoke


def test_boxes_of_ones_own(tmp_path: Path) -> None:
    own = write_box_dataset(tmp_path / "own", 4)
    rows = ["scan,class,x,y,z,length,width,height,yaw,track_id"]
    rows += [f"{number:06d}.bin,Forklift,{10 + number},1,-1,2.5,1.2,2,0.5,t{number}" for number in range(3)]
    (tmp_path / "boxes.csv").write_text("\n".join(rows))
    output = invoke("import", tmp_path / "boxes.csv", tmp_path / "out", "--scans", own / "scans", "--val-share", 0.5)
    assert "2 frames to train on, 2 to validate; boxes: Forklift 3" in output.replace("\n", " ")
    split = BoxSplit(tmp_path / "out", "val")
    assert split.frame_ids == ("000002", "000003")  # without a row: no objects
    assert split.labeled_boxes("000002").boxes[0].tolist() == pytest.approx([12, 1, -1, 2.5, 1.2, 2, 0.5])
    assert split.records("000002").track_ids == ("t2",)
    assert split.scan_path("000002").parent == own / "scans"  # referred to, not copied
    invoke("import", tmp_path / "boxes.csv", tmp_path / "out", "--scans", own / "scans")  # replaces its own


def test_an_import_is_not_imported_over_itself(tmp_path: Path) -> None:
    own = write_box_dataset(tmp_path / "own", 4)
    invoke("import", own / "labels.jsonl", tmp_path / "out", "--scans", own / "scans")
    labels = tmp_path / "out" / "labels.jsonl"
    (tmp_path / "link.jsonl").symlink_to(labels)
    before = labels.read_bytes()
    for source in (labels, tmp_path / "link.jsonl"):
        with pytest.raises(OutputError, match=r"labels\.jsonl: would replace .*, which is read"):
            invoke("import", source, tmp_path / "out", "--scans", own / "scans", "--rename", "Car=Van")
    assert labels.read_bytes() == before
    labels.write_text("my notes on labels\n")
    with pytest.raises(OutputError, match=r"labels\.jsonl: `asca import` did not write it"):
        invoke("import", own / "labels.jsonl", tmp_path / "out", "--scans", own / "scans")
    labels.unlink()
    labels.symlink_to(own / "labels.jsonl")
    with pytest.raises(OutputError, match="is a link"):
        invoke("import", tmp_path / "own" / "labels.jsonl", tmp_path / "out", "--scans", own / "scans")


@pytest.mark.parametrize("settings", ["", "axes: y-forward\n"])
def test_a_dataset_that_was_written_by_hand_stays(tmp_path: Path, settings: str) -> None:
    """docs/DATA.md tells to write the very files that an import writes, which may be weeks of labels."""
    own, other = write_box_dataset(tmp_path / "own", 4), write_box_dataset(tmp_path / "other", 2)
    (own / "dataset.yaml").write_text(settings)
    before = {path: path.read_bytes() for path in own.rglob("*") if path.is_file()}
    with pytest.raises(OutputError, match=r"own/dataset\.yaml: .* another OUT, such as /.*/own_imported$") as caught:
        invoke("import", other / "labels.jsonl", own, "--scans", other / "scans")
    assert "\n" not in str(caught.value)
    assert {path: path.read_bytes() for path in own.rglob("*") if path.is_file()} == before


def test_classes_by_other_names(tmp_path: Path) -> None:
    own = write_box_dataset(tmp_path / "own", 4)
    source = (own / "labels.jsonl", tmp_path / "out", "--scans", own / "scans")
    output = invoke("import", *source, "--rename", "Forklift=Truck", "--rename", "Car=Truck")
    assert "boxes: Truck 8" in output
    assert "boxes: Big one 4" in invoke(
        "import", *source, "--rename", "Car= Big\n one", "--rename", "Forklift=Truck"
    ).replace("Truck 4, ", "")
    for text, message in (
        ("Bus=Truck", "no box has that class; there are Car, Forklift"),
        ("Car", "write OLD=NEW"),
        ("Car= ", "the new name is ' ', no name"),
    ):
        with pytest.raises(ConfigError, match=message):
            invoke("import", *source, "--rename", text)


def test_the_end_of_a_recording_is_its_last_scans(tmp_path: Path) -> None:
    own = write_box_dataset(tmp_path / "own", 12)
    for number in range(12):  # as text, 10 comes before 2
        (own / "scans" / f"{number:06d}.bin").rename(own / "scans" / f"{number}.bin")
    (tmp_path / "boxes.csv").write_text("scan,class,x,y,z,length,width,height,yaw\n3.bin,Car,9,0,0,4,2,1,0\n")
    source = (tmp_path / "boxes.csv", tmp_path / "out", "--scans", own / "scans")
    invoke("import", *source, "--val-share", 0.25)
    assert set(BoxSplit(tmp_path / "out", "val").frame_ids) == {"9", "10", "11"}
    assert not {"9", "10", "11"} & set(BoxSplit(tmp_path / "out", "train").frame_ids)


def test_of_two_scans_one_is_for_validation(tmp_path: Path) -> None:
    own = write_box_dataset(tmp_path / "own", 2)
    invoke("import", own / "labels.jsonl", tmp_path / "out", "--scans", own / "scans", "--val-share", 0.6)
    assert BoxSplit(tmp_path / "out", "train").frame_ids == ("000000",)
    assert BoxSplit(tmp_path / "out", "val").frame_ids == ("000001",)


def test_recordings_are_not_torn_apart(tmp_path: Path) -> None:
    own = write_box_dataset(tmp_path / "own", 4)
    for number, folder in enumerate("aabb"):
        (own / "scans" / folder).mkdir(exist_ok=True)
        (own / "scans" / f"{number:06d}.bin").rename(own / "scans" / folder / f"{number:06d}.bin")
    (tmp_path / "boxes.csv").write_text("scan,class,x,y,z,length,width,height,yaw\na/000000.bin,Car,9,0,0,4,2,1,0")
    invoke("import", tmp_path / "boxes.csv", tmp_path / "out", "--scans", own / "scans", "--val-share", 0.3)
    assert BoxSplit(tmp_path / "out", "train").frame_ids == ("a/000000", "a/000001")
    assert BoxSplit(tmp_path / "out", "val").frame_ids == ("b/000002", "b/000003")


def test_argoverse2(tmp_path: Path) -> None:
    source = write_argoverse2(tmp_path / "av2")
    assert "REGULAR_VEHICLE 2" in invoke("import", source, tmp_path / "out", "--from", "argoverse2")
    split = BoxSplit(tmp_path / "out", "train")
    assert split.frame_ids == ("val/log_a/sensors/lidar/315966265259836000",)  # the other sweep is not there
    boxes = split.labeled_boxes(split.frame_ids[0]).boxes
    assert boxes[0].tolist() == pytest.approx([20, 5, 1, 4, 2, 1.6, 0.7])
    np.testing.assert_allclose(split.to_sensor.points(np.array([[1.35, 0, 1.64]])), 0, atol=1e-6)
    points = split.points(split.frame_ids[0])
    assert points_in_boxes(points, boxes).all() and points[:, 3].min() >= 0 and 0.5 < points[:, 3].max() <= 1
    # The sweeps are scans for every command, labels and poses beside them are not.
    assert [path.stem for path in find_scans(source)] == ["315966265259836000"] * 2
    assert len(read_scan(find_scans(source)[0]).points) == 50


def test_argoverse2_of_links(tmp_path: Path) -> None:
    source = write_argoverse2(tmp_path / "av2")
    lidar = source / "val" / "log_a" / "sensors" / "lidar"
    lidar.rename(tmp_path / "elsewhere")
    lidar.symlink_to(tmp_path / "elsewhere")
    (source / "val" / "log_b").rename(tmp_path / "log_b")
    (source / "val" / "log_b").symlink_to(tmp_path / "log_b")
    invoke("import", source, tmp_path / "out", "--from", "argoverse2")
    assert BoxSplit(tmp_path / "out").frame_ids == tuple(
        f"val/{log}/sensors/lidar/315966265259836000" for log in ("log_a", "log_b")
    )


def test_argoverse2_mistakes_are_named(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    unusable = r"no box .* boxes: 4, the first: .*log_a/annotations\.feather, row 0: no box with finite numbers"
    with pytest.raises(DatasetError, match=unusable):
        invoke("import", write_argoverse2(tmp_path / "still", turn=[0] * 4), tmp_path / "out", "--from", "argoverse2")
    (tmp_path / "none").mkdir()
    with pytest.raises(DatasetError, match=r"no annotations\.feather below"):
        invoke("import", tmp_path / "none", tmp_path / "out", "--from", "argoverse2")
    from pyarrow import feather, table

    columns = {name: ["?"] if name == "y" else [1.0] for name in ("x", "y", "z", "intensity")}
    feather.write_feather(table(columns), tmp_path / "2.feather")
    with pytest.raises(ScanError, match=r"2\.feather: column `y` is not what Argoverse 2 has there"):
        read_scan(tmp_path / "2.feather")
    feather.write_feather(table({"x": [1.0]}), tmp_path / "2.feather")
    with pytest.raises(ScanError, match=r"2\.feather: no column `y` \(there are: x\)"):
        read_scan(tmp_path / "2.feather")
    (tmp_path / "1.feather").write_bytes(b"no feather")
    with pytest.raises(ScanError, match=r"1\.feather: no readable feather file"):
        read_scan(tmp_path / "1.feather")


def test_nuscenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = write_nuscenes(tmp_path / "nuscenes")
    invoke("import", source, tmp_path / "out", "--from", "nuscenes")
    split = BoxSplit(tmp_path / "out", "train")
    (frame_id,) = split.frame_ids
    boxes, types = split.labeled_boxes(frame_id)
    assert types == ("car", "animal")
    (right, ahead, up), turn = in_sensor()
    nose_right, nose_ahead, _ = turn.apply([1, 0, 0])
    yaw = np.arctan2(-nose_right, nose_ahead)
    assert boxes[0].tolist() == pytest.approx([ahead, -right, up, 4.5, 2, 1.6, yaw], abs=1e-4)
    points = split.points(frame_id)
    assert points_in_boxes(points, boxes[:1]).all() and points[:, 3] == pytest.approx(51 / 255)
    monkeypatch.chdir(source / "v1.0-mini")
    assert len(read_nuscenes(Path()).frames) == 1, "the tables' own folder"


def test_nuscenes_mistakes_are_named(tmp_path: Path) -> None:
    source = write_nuscenes(tmp_path / "nuscenes")
    with pytest.raises(DatasetError, match=r"one v1\.0-\*/ with nuScenes' tables is needed, there is none"):
        read_nuscenes(tmp_path)
    poses = source / "v1.0-mini" / "ego_pose.json"
    whole = poses.read_text()
    poses.write_text(whole.replace("translation", "somewhere"))
    with pytest.raises(DatasetError, match=r"no labelled scan .* frames: 1, .*sample_data\.json, x: no `translation`"):
        drop_unwritable(read_nuscenes(source))
    poses.write_text(whole)
    for name, old, new, message in (
        (
            "sample_annotation",
            "[2.0, 4.5, 1.6]",
            "[0, 4.5, 1.6]",
            r"boxes: 1, .*LIDAR_TOP__1\.pcd\.bin: no box of a car",
        ),
        ("sample_annotation", "[2.0, 4.5, 1.6]", "[1e400, 4.5, 1.6]", r"boxes: 1, .*annotation\.json, 1: size is"),
        ("sample_annotation", '"instance_token": "i"', '"instance_token": ["i"]', r"boxes: 1, .*instance\.json has no"),
        ("ego_pose", json.dumps(quaternion(POSE)), "[0, 0, 0, 0]", r"frames: 1, .*rotation is \[0, 0, 0, 0\]"),
        (
            "calibrated_sensor",
            "[0.9, 0.0, 1.8]",
            "[0, 0]",
            r"frames: 1, .*translation is \[0, 0\], not 3 finite numbers",
        ),
        ("sample_data", "samples/LIDAR_TOP", "../nuscenes/samples/LIDAR_TOP", r"frames: 1, .*no file below"),
        ("scene", '"scene-0001"', "7", r"frames: 1, .*the scene's name is 7"),
        ("sensor", '"l"', "[7]", r"rows: 1, .*sensor\.json, row 0: token is \[7\]"),
    ):
        path = source / "v1.0-mini" / f"{name}.json"
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))
        imported = read_nuscenes(source)
        with contextlib.suppress(DatasetError):
            imported = drop_unwritable(imported)
        assert re.search(message, " ".join(imported.left_out.lines())), imported.left_out.lines()
        if message.startswith("boxes"):
            assert [frame.records.types for frame in imported.frames] == [("animal",)], "the other box stays"
        path.write_text(text)
    table = source / "v1.0-mini" / "scene.json"
    table.write_text("7")
    with pytest.raises(DatasetError, match=r"scene\.json: no table of nuScenes"):
        read_nuscenes(source)
    table.unlink()
    with pytest.raises(DatasetError, match=r"scene\.json: cannot be read"):
        read_nuscenes(source / "v1.0-mini")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["none.csv", "out", "--scans", "s"], "none.csv: no such file or folder"),
        (["own", "out"], "--scans FOLDER goes with --from boxes"),
        (["own", "out", "--from", "nuscenes", "--scans", "s"], "--scans FOLDER goes with --from boxes"),
        (["own/labels.jsonl", "own/scans", "--scans", "own/scans"], "scans"),
    ],
)
def test_what_cannot_be_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], message: str
) -> None:
    write_box_dataset(tmp_path / "own", 2)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(AscaError) as caught:
        invoke("import", *arguments)
    assert message in str(caught.value) and "\n" not in str(caught.value)
