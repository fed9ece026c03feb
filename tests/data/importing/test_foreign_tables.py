"""Tables that are damaged or made to do harm: one bad row costs itself, and nothing is written outside the target."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asca_pillars.base.errors import DatasetError
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.importing.argoverse2 import read_argoverse2
from asca_pillars.data.importing.imported import drop_unwritable
from asca_pillars.data.importing.nuscenes import read_nuscenes
from tests.data.boxes.box_scenes import write_box_dataset
from tests.data.importing.foreign_datasets import write_argoverse2, write_nuscenes
from tests.data.importing.waymo_segment import LASER, TIME, write_segment
from tests.helpers.in_process import invoke

BOX = "[LiDARBoxComponent].box"
IMAGE = "[LiDARComponent].range_image_return1"


def change_parquet(path: Path, column: str, change: Callable[[list[Any]], list[Any]], keep_type: bool = True) -> None:
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    table = parquet.read_table(path)
    index = table.column_names.index(column)
    values = change(table.column(index).to_pylist())
    array = pyarrow.array(values, table.schema.field(index).type if keep_type else None)
    parquet.write_table(table.set_column(index, column, array), path)


@pytest.mark.parametrize(("name", "table"), [("../../../{0}", "lidar"), ("{1}/{0}", "lidar_box"), ("..", "lidar_box")])
def test_a_time_stamp_makes_no_path(name: str, table: str, tmp_path: Path) -> None:
    source, out, column = write_segment(tmp_path / "a" / "b" / "waymo"), tmp_path / "a" / "b" / "out", TIME
    target = name.format("stolen", tmp_path)
    change_parquet(source / table / "segment.parquet", column, lambda old: [target] * len(old), False)
    before = set(tmp_path.rglob("*"))
    with pytest.raises(DatasetError, match=r"key\.frame_timestamp_micros is '.*', not a whole number"):
        invoke("import", source, out, "--from", "waymo")
    assert all(path.is_relative_to(out) for path in set(tmp_path.rglob("*")) - before)


@pytest.mark.parametrize(
    ("column", "value"),
    [
        (f"{BOX}.size.x", 0.0),
        (f"{BOX}.size.z", 4e-5),  # written as 0.0000
        (f"{BOX}.center.x", 2e6),
        (f"{BOX}.center.y", float("nan")),
        (f"{BOX}.heading", 235.0),
        (f"{BOX}.center.z", None),
        ("key.laser_object_id", "a\nb\0"),
        ("[LiDARBoxComponent].type", None),
    ],
)
def test_one_bad_box_of_waymo_costs_itself(column: str, value: Any, tmp_path: Path) -> None:
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    source = write_segment(tmp_path / "waymo")
    path = source / "lidar_box" / "segment.parquet"
    parquet.write_table(pyarrow.concat_tables([parquet.read_table(path)] * 2), path)
    change_parquet(path, column, lambda old: [old[0], value])
    output = invoke("import", source, tmp_path / "out", "--from", "waymo")
    assert "boxes: Vehicle 1" in output and "left out, boxes: 1, the first: " in output
    assert len(BoxSplit(tmp_path / "out").records("segment/1000").boxes) == 1


@pytest.mark.parametrize(
    ("table", "column", "value", "message"),
    [
        ("lidar", f"{IMAGE}.shape", [4, -360, -4], "for the shape"),
        ("lidar", f"{IMAGE}.shape", [3, 480, 4], "for 4 lasers"),
        ("lidar", f"{IMAGE}.shape", [4, 1440, 1], "for 4 lasers"),
        ("lidar", f"{IMAGE}.shape", [2**31 - 1] * 3, "not 3 finite numbers"),
        ("lidar", LASER, 7, "sensor 7 has no usable calibration"),
        ("lidar_pose", "[LiDARPoseComponent].range_image_return1.shape", [4, 1080, 2], "poses of shape"),
    ],
)
def test_one_bad_image_of_waymo_costs_its_frame(
    table: str, column: str, value: Any, message: str, tmp_path: Path
) -> None:
    source = write_segment(tmp_path / "waymo", moved_m=1.0)
    row = -2 if table == "lidar" else -1  # of the roof's sensor in the last frame
    path = source / table / "segment.parquet"
    change_parquet(path, column, lambda old: [*old[:row], value, *old[len(old) + row + 1 :]])
    output = invoke("import", source, tmp_path / "out", "--from", "waymo")
    assert re.search(f"left out, frames: 1, the first: .*{message}", output), output
    assert BoxSplit(tmp_path / "out").frame_ids == ("segment/1000",)


@pytest.mark.parametrize("value", [[1, 2], "1", None])
@pytest.mark.parametrize("table", ["lidar", "lidar_pose", "lidar_calibration"])
def test_a_sensor_of_waymo_is_a_number(table: str, value: Any, tmp_path: Path) -> None:
    source = write_segment(tmp_path / "waymo", moved_m=1.0)
    change_parquet(source / table / "segment.parquet", LASER, lambda old: [value] * len(old), False)
    if table == "lidar_pose":  # points stay where they were measured
        assert "boxes: Vehicle 1" in invoke("import", source, tmp_path / "out", "--from", "waymo")
    else:
        with pytest.raises(DatasetError, match="no labelled scan there that can be used"):
            invoke("import", source, tmp_path / "out", "--from", "waymo")


@pytest.mark.parametrize(
    ("column", "value"),
    [
        *(("extrinsic.transform", value) for value in ([float("nan")] * 16, [0.0] * 16, [1.0, 2.0])),
        *(("beam_inclination.values", value) for value in ([float("nan")] * 4, [0.0] * 3)),
    ],
)
def test_a_calibration_of_waymo_is_checked(column: str, value: Any, tmp_path: Path) -> None:
    source = write_segment(tmp_path / "waymo")
    path, column = source / "lidar_calibration" / "segment.parquet", f"[LiDARCalibrationComponent].{column}"
    change_parquet(path, column, lambda old: [value, *old[1:]])
    with pytest.raises(DatasetError, match="no labelled scan there that can be used"):
        invoke("import", source, tmp_path / "out", "--from", "waymo")


def change_rows(source: Path, table: str, change: Callable[[list[dict[str, Any]]], object]) -> None:
    path = source / "v1.0-mini" / f"{table}.json"
    rows = json.loads(path.read_text())
    change(rows)
    path.write_text(json.dumps(rows))


@pytest.mark.parametrize(
    "name", ["../../secret.bin", "{0}", "samples/../../secret.bin", "samples/LIDAR_TOP/../../../secret.bin"]
)
def test_a_table_names_no_file_outside_its_dataset(name: str, tmp_path: Path) -> None:
    source, secret = write_nuscenes(tmp_path / "a" / "nuscenes"), tmp_path / "secret.bin"
    for path in (secret, tmp_path / "a" / "secret.bin"):
        path.write_bytes(b"\0" * 400)
    evil = {"token": "evil", "filename": name.format(secret)}
    change_rows(source, "sample_data", lambda rows: rows.append(rows[0] | evil))
    imported = drop_unwritable(read_nuscenes(source))
    assert len(imported.frames) == 1 and imported.skipped.counts["frames"] == 1
    assert "not a file below" in imported.skipped.lines()[0]


@pytest.mark.parametrize(
    ("table", "key", "value", "message"),
    [
        ("sample_annotation", "size", [1, 2, 10**400], "boxes: 1, .*sample_annotation.json, 1: size is"),
        ("sample_annotation", "size", [0, 4.5, 1.6], r"boxes: 1, .*LIDAR_TOP__1\.pcd\.bin: no box of a car"),
        ("sample_annotation", "translation", [1e300, 0, 0], "boxes: 1, .*not 3 finite"),
        ("sample_annotation", "rotation", ["1", "0", "0", "0"], "boxes: 1, .*not 4 finite"),
        ("sample_annotation", "instance_token", {"token": "i"}, "boxes: 1, .*instance.json has no"),
        ("sample_annotation", "sample_token", 7, "boxes: 1, .*sample_token is 7, not a name"),
        ("instance", "category_token", ["k"], "boxes: 1, .*category.json has no"),
        ("category", "name", "\n", "boxes: 1, .*not a name"),
        ("ego_pose", "rotation", [0, 0, 0, 0], r"frames: 1, .*rotation is \[0, 0, 0, 0\]"),
        ("ego_pose", "translation", None, r"frames: 1, .*sample_data\.json, x: translation is None"),
        ("calibrated_sensor", "translation", [0, 0], r"frames: 1, .*translation is \[0, 0\], not 3 finite numbers"),
        ("scene", "name", 7, "frames: 1, .*the scene's name is 7"),
        ("sensor", "token", [7], r"rows: 1, .*sensor\.json, row 0: token is \[7\]"),
    ],
)
def test_one_bad_row_of_nuscenes_costs_itself(table: str, key: str, value: Any, message: str, tmp_path: Path) -> None:
    source = write_nuscenes(tmp_path)
    change_rows(source, table, lambda rows: rows[0].update({key: value}))
    imported = read_nuscenes(source)
    if message.startswith("boxes"):
        imported = drop_unwritable(imported)
        assert [frame.records.types for frame in imported.frames] == [("animal",)]
    else:
        with pytest.raises(DatasetError, match="no labelled scan there that can be used"):
            drop_unwritable(imported)
    assert re.search(message, " ".join(imported.skipped.lines())), imported.skipped.lines()


@pytest.mark.parametrize(
    ("column", "value"),
    [("tx_m", float("nan")), ("length_m", 0.0), ("width_m", 3e-5), ("tz_m", 1e7), ("category", None), ("qw", None)],
)
def test_one_bad_row_of_argoverse_costs_itself(column: str, value: Any, tmp_path: Path) -> None:
    source = write_argoverse2(tmp_path)
    pyarrow, feather = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.feather")
    path = source / "val" / "log_a" / "annotations.feather"
    table = feather.read_table(path)
    table = pyarrow.concat_tables([table, table])
    index = table.column_names.index(column)
    values = [value, *table.column(index).to_pylist()[1:]]
    array = pyarrow.array(values, table.schema.field(index).type)
    feather.write_feather(table.set_column(index, column, array), path)
    imported = drop_unwritable(read_argoverse2(source))
    assert [len(frame.records.types) for frame in imported.frames] == [1, 1]
    assert re.search(r"boxes: 1, the first: .*annotations\.feather, row 0", imported.skipped.lines()[0])


@pytest.mark.parametrize("name", ["000001 ", "00\n0001", "00\u20280001", "\ufeff000001", "00\\0001"])
def test_scans_whose_names_no_list_can_hold_are_left_out(name: str, tmp_path: Path) -> None:
    scans, labels = write_box_dataset(tmp_path / "own", 3) / "scans", tmp_path / "labels"
    labels.mkdir()
    (scans / "000001.bin").rename(scans / f"{name}.bin")
    for frame_id in ("000000", name, "000002"):
        (labels / f"{frame_id}.json").write_text('{"boxes": []}')
    assert "left out, frames: 1, the first: " in invoke("import", labels, tmp_path / "out", "--scans", scans)
    listed = [BoxSplit(tmp_path / "out", split).frame_ids for split in ("training", "train", "val")]
    assert listed[0] == ("000000", "000002") and set(listed[1] + listed[2]) <= set(listed[0])


def test_boxes_that_could_not_be_read_again_are_left_out(tmp_path: Path) -> None:
    """Read as they stand, they are fine; four decimals make nothing of one, and a million of the other."""
    scans, boxes = write_box_dataset(tmp_path / "own", 1) / "scans", tmp_path / "boxes.csv"
    rows = ("9,0,0,4,2,0.00004,0", "999999.99999,0,0,4,2,1,0", "9,0,0,4,2,1,6.2")
    header = "scan,class,x,y,z,length,width,height,yaw"
    boxes.write_text("\n".join([header, *(f"000000.bin,Car,{row}" for row in rows)]))
    output = invoke("import", boxes, tmp_path / "out", "--scans", scans)
    assert "boxes: Car 1" in output and "left out, boxes: 2" in output
    np.testing.assert_allclose(BoxSplit(tmp_path / "out").records("000000").boxes[0, 6], 6.2 - 2 * np.pi, atol=1e-4)


def test_labels_that_cannot_be_read_again_replace_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own, out = write_box_dataset(tmp_path / "own", 2), tmp_path / "out"
    source = (own / "labels.jsonl", out, "--scans", own / "scans")
    invoke("import", *source)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    line = "asca_pillars.data.importing.imported.json_line"
    monkeypatch.setattr(line, lambda scan, *_: json.dumps({"scan": scan, "boxes": []}) + "\n")
    with pytest.raises(DatasetError, match="cannot be read again"):
        invoke("import", *source)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
