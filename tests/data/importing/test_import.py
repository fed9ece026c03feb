"""Imports of small datasets in their published formats, made here."""

import json
from pathlib import Path

import numpy as np
import pytest

from asca_pillars.base.errors import AscaError, ConfigError, DatasetError, OutputError, ScanError
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.importing.nuscenes import read_nuscenes
from asca_pillars.geometry.boxes import points_in_boxes
from asca_pillars.scans.find_scans import find_scans
from asca_pillars.scans.scan_reader import read_scan
from tests.data.boxes.box_scenes import write_box_dataset
from tests.data.importing.foreign_datasets import in_sensor, write_argoverse2, write_nuscenes
from tests.helpers.in_process import invoke


def test_boxes_of_ones_own(tmp_path: Path) -> None:
    scans, boxes, out = write_box_dataset(tmp_path / "own", 4) / "scans", tmp_path / "boxes.csv", tmp_path / "out"
    rows = [f"{number:06d}.bin,Forklift,{10 + number},1,-1,2.5,1.2,2,0.5,t{number}" for number in range(3)]
    boxes.write_text("\n".join(["scan,class,x,y,z,length,width,height,yaw,track_id", *rows]))
    output = invoke("import", boxes, out, "--scans", scans, "--val-share", 0.5)
    assert "2 frames to train on, 2 to validate; boxes: Forklift 3" in output.replace("\n", " ")
    split = BoxSplit(out, "val")
    assert split.frame_ids == ("000002", "000003")  # without a row: no objects
    assert split.labeled_boxes("000002").boxes[0].tolist() == pytest.approx([12, 1, -1, 2.5, 1.2, 2, 0.5])
    assert split.records("000002").track_ids == ("t2",)
    assert split.scan_path("000002").parent == scans  # referred to, not copied
    invoke("import", boxes, out, "--scans", scans)  # replaces its own


def test_times_of_ones_own_stay_and_hidden_labels_are_none(tmp_path: Path) -> None:
    scans, labels, out = write_box_dataset(tmp_path / "own", 3) / "scans", tmp_path / "labels", tmp_path / "out"
    labels.mkdir()
    lines = [{"scan": f"{number:06d}.bin", "time_s": number / 10, "boxes": []} for number in range(2)]
    lines.append({"scan": "000002.bin", "boxes": []})
    (tmp_path / "boxes.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    invoke("import", tmp_path / "boxes.jsonl", out, "--scans", scans)
    assert BoxSplit(out).times_s == {"000000": 0.0, "000001": 0.1}
    (labels / "000000.json").write_text('{"boxes": []}')
    (labels / "._000000.json").write_bytes(b"\0")  # as macOS leaves them on a disk that it did not format
    invoke("import", labels, out, "--scans", scans)
    assert BoxSplit(out).frame_ids == ("000000",)


def test_an_import_is_not_imported_over_itself(tmp_path: Path) -> None:
    own = write_box_dataset(tmp_path / "own", 4)
    rest = (tmp_path / "out", "--scans", own / "scans")
    invoke("import", own / "labels.jsonl", *rest)
    labels = tmp_path / "out" / "labels.jsonl"
    (tmp_path / "link.jsonl").symlink_to(labels)
    before = labels.read_bytes()
    for source in (labels, tmp_path / "link.jsonl"):
        with pytest.raises(OutputError, match=r"labels\.jsonl: would replace the input "):
            invoke("import", source, *rest, "--rename", "Car=Van")
    assert labels.read_bytes() == before
    labels.write_text("my notes on labels\n")
    with pytest.raises(OutputError, match=r"labels\.jsonl: `asca import` did not write it"):
        invoke("import", own / "labels.jsonl", *rest)
    labels.unlink()
    labels.symlink_to(own / "labels.jsonl")
    with pytest.raises(OutputError, match="is a link"):
        invoke("import", own / "labels.jsonl", *rest)


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
    assert "boxes: Truck 8" in invoke("import", *source, "--rename", "Forklift=Truck", "--rename", "Car=Truck")
    assert "Big one 4" in invoke("import", *source, "--rename", "Car= Big\n one", "--rename", "Forklift=Truck")
    wrong = ("Bus=Truck", "no box has that class; the labels have Car, Forklift"), ("Car", "write OLD=NEW")
    for text, message in (*wrong, ("Car= ", "the new name is ' ', not a name")):
        with pytest.raises(ConfigError, match=message):
            invoke("import", *source, "--rename", text)


@pytest.mark.parametrize(
    ("scans", "share", "val"),
    [
        ([str(number) for number in range(12)], 0.25, {"9", "10", "11"}),  # as text, 10 comes before 2
        (["0", "1"], 0.6, {"1"}),  # one is left to train on
        (["a/0", "a/1", "b/2", "b/3"], 0.1, {"b/2", "b/3"}),  # recordings are not torn apart
    ],
)
def test_the_end_is_for_validation(tmp_path: Path, scans: list[str], share: float, val: set[str]) -> None:
    folder = write_box_dataset(tmp_path / "own", len(scans)) / "scans"
    boxes, out = tmp_path / "boxes.csv", tmp_path / "out"
    for number, name in enumerate(scans):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / f"{number:06d}.bin").rename(folder / f"{name}.bin")
    boxes.write_text(f"scan,class,x,y,z,length,width,height,yaw\n{scans[0]}.bin,Car,9,0,0,4,2,1,0\n")
    invoke("import", boxes, out, "--scans", folder, "--val-share", share)
    assert set(BoxSplit(out, "val").frame_ids) == val
    assert set(BoxSplit(out, "train").frame_ids) == set(scans) - val


@pytest.mark.parametrize("linked", [False, True])
def test_argoverse2(tmp_path: Path, linked: bool) -> None:
    source, out = write_argoverse2(tmp_path / "av2"), tmp_path / "out"
    for part in ("log_a/sensors/lidar", "log_b") if linked else ():
        path = source / "val" / part
        path.rename(elsewhere := tmp_path / path.name)
        path.symlink_to(elsewhere)
    assert "REGULAR_VEHICLE 2" in invoke("import", source, out, "--from", "argoverse2")
    # One sweep of each log is there, its labels tell of two.
    sweeps = tuple(f"val/{log}/sensors/lidar/315966265259836000" for log in ("log_a", "log_b"))
    assert BoxSplit(out).frame_ids == sweeps
    split = BoxSplit(out, "train")
    assert split.frame_ids == sweeps[:1]
    boxes, points = split.labeled_boxes(sweeps[0]).boxes, split.points(sweeps[0])
    assert boxes[0].tolist() == pytest.approx([20, 5, 1, 4, 2, 1.6, 0.7])
    np.testing.assert_allclose(split.to_sensor.points(np.array([[1.35, 0, 1.64]])), 0, atol=1e-6)
    assert points_in_boxes(points, boxes).all() and points[:, 3].min() >= 0 and 0.5 < points[:, 3].max() <= 1
    # The sweeps are scans for every command, labels and poses beside them are not.
    assert [path.stem for path in find_scans(source)] == ["315966265259836000"] * 2
    assert len(read_scan(find_scans(source)[0]).points) == 50


def test_argoverse2_mistakes_are_named(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    from pyarrow import feather, table

    unusable = r"no box .* boxes: 4, the first: .*log_a/annotations\.feather, row 0: no box with finite numbers"
    with pytest.raises(DatasetError, match=unusable):
        invoke("import", write_argoverse2(tmp_path / "still", turn=[0] * 4), tmp_path / "out", "--from", "argoverse2")
    (tmp_path / "none").mkdir()
    with pytest.raises(DatasetError, match=r"no annotations\.feather below"):
        invoke("import", tmp_path / "none", tmp_path / "out", "--from", "argoverse2")
    sweep = tmp_path / "2.feather"
    for columns, message in (
        ({name: ["?"] if name == "y" else [1.0] for name in ("x", "y", "z", "intensity")}, "column `y` is not what"),
        ({"x": [1.0]}, r"no column `y` \(there are: x\)"),
        (None, "not a readable feather file"),
    ):
        sweep.write_bytes(b"no feather") if columns is None else feather.write_feather(table(columns), sweep)
        with pytest.raises(ScanError, match=rf"2\.feather: {message}"):
            read_scan(sweep)


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
    table = source / "v1.0-mini" / "scene.json"
    with pytest.raises(DatasetError, match=r"one v1\.0-\*/ with nuScenes' tables is needed, found none"):
        read_nuscenes(tmp_path)
    table.write_text("7")
    with pytest.raises(DatasetError, match=r"scene\.json: not a nuScenes table"):
        read_nuscenes(source)
    table.unlink()
    with pytest.raises(DatasetError, match=r"scene\.json: cannot be read"):
        read_nuscenes(source / "v1.0-mini")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["none.csv", "out", "--scans", "s"], "none.csv: no such file or folder"),
        (["own", "out"], "--scans FOLDER is for --from boxes"),
        (["own", "out", "--from", "nuscenes", "--scans", "s"], "--scans FOLDER is for --from boxes"),
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
