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
from tests.data.importing.waymo_segment import write_segment
from tests.helpers.in_process import invoke

BOX = "[LiDARBoxComponent].box"
CALIBRATION = "[LiDARCalibrationComponent]"
IMAGE = "[LiDARComponent].range_image_return1"


def change_parquet(path: Path, column: str, change: Callable[[list[Any]], list[Any]], keep_type: bool = True) -> None:
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    table = parquet.read_table(path)
    index = table.column_names.index(column)
    values = change(table.column(index).to_pylist())
    array = pyarrow.array(values, table.schema.field(index).type if keep_type else None)
    parquet.write_table(table.set_column(index, column, array), path)


def repeat_rows(path: Path) -> None:
    """Each row twice."""
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    table = parquet.read_table(path)
    parquet.write_table(pyarrow.concat_tables([table, table]), path)


@pytest.mark.parametrize("name", ["../../../{0}", "{1}/{0}", "..", "a/b"])
@pytest.mark.parametrize("table", ["lidar", "lidar_box"])
def test_a_time_stamp_makes_no_path(name: str, table: str, tmp_path: Path) -> None:
    source = write_segment(tmp_path / "deep" / "er" / "waymo")
    target = name.format("stolen", tmp_path)
    change_parquet(
        source / table / "segment.parquet", "key.frame_timestamp_micros", lambda old: [target] * len(old), False
    )
    before = set(tmp_path.rglob("*"))
    with pytest.raises(DatasetError, match=r"key\.frame_timestamp_micros is '.*', no whole number"):
        invoke("import", source, tmp_path / "deep" / "er" / "out", "--from", "waymo")
    assert all(
        (tmp_path / "deep" / "er" / "out") in path.parents or path.name == "out"
        for path in set(tmp_path.rglob("*")) - before
    )


@pytest.mark.parametrize(
    ("column", "value"),
    [
        (f"{BOX}.size.x", 0.0),
        (f"{BOX}.size.y", -2.0),
        (f"{BOX}.size.z", 4e-5),  # written as 0.0000
        (f"{BOX}.center.x", 2e6),
        (f"{BOX}.center.y", float("nan")),
        (f"{BOX}.heading", float("inf")),
        (f"{BOX}.heading", 235.0),
        (f"{BOX}.center.z", None),
        ("key.laser_object_id", "a\nb\0"),
        ("[LiDARBoxComponent].type", None),
    ],
)
def test_one_bad_box_of_waymo_costs_itself(column: str, value: Any, tmp_path: Path) -> None:
    source = write_segment(tmp_path / "waymo")
    path = source / "lidar_box" / "segment.parquet"
    repeat_rows(path)
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
        ("lidar", "key.laser_name", 7, "sensor 7 has no usable calibration"),
        ("lidar_pose", "[LiDARPoseComponent].range_image_return1.shape", [4, 1080, 2], "poses of shape"),
    ],
)
def test_one_bad_image_of_waymo_costs_its_frame(
    table: str, column: str, value: Any, message: str, tmp_path: Path
) -> None:
    source = write_segment(tmp_path / "waymo", moved_m=1.0)
    change_parquet(
        source / table / "segment.parquet",
        column,
        lambda old: [*old[:-2], value, old[-1]] if table == "lidar" else [old[0], value],
    )
    output = invoke("import", source, tmp_path / "out", "--from", "waymo")
    assert re.search(f"left out, frames: 1, the first: .*{message}", output), output
    assert BoxSplit(tmp_path / "out").frame_ids == ("segment/1000",)


@pytest.mark.parametrize("value", [[1, 2], {"a": 1}, "1", 1.5, None])
@pytest.mark.parametrize("table", ["lidar", "lidar_pose", "lidar_calibration"])
def test_a_sensor_of_waymo_is_a_number(table: str, value: Any, tmp_path: Path) -> None:
    source = write_segment(tmp_path / "waymo", moved_m=1.0)
    change_parquet(source / table / "segment.parquet", "key.laser_name", lambda old: [value] * len(old), False)
    if table == "lidar_pose":  # points stay where they were measured
        assert "boxes: Vehicle 1" in invoke("import", source, tmp_path / "out", "--from", "waymo")
    else:
        with pytest.raises(DatasetError, match="no labelled scan there that can be used"):
            invoke("import", source, tmp_path / "out", "--from", "waymo")


@pytest.mark.parametrize(
    ("column", "value"),
    [
        (f"{CALIBRATION}.extrinsic.transform", [float("nan")] * 16),
        (f"{CALIBRATION}.extrinsic.transform", [0.0] * 16),
        (f"{CALIBRATION}.extrinsic.transform", [1.0, 2.0]),
        (f"{CALIBRATION}.beam_inclination.values", [float("nan")] * 4),
        (f"{CALIBRATION}.beam_inclination.values", [0.0] * 3),
    ],
)
def test_a_calibration_of_waymo_is_checked(column: str, value: Any, tmp_path: Path) -> None:
    source = write_segment(tmp_path / "waymo")
    change_parquet(source / "lidar_calibration" / "segment.parquet", column, lambda old: [value, *old[1:]])
    with pytest.raises(DatasetError, match="no labelled scan there that can be used"):
        invoke("import", source, tmp_path / "out", "--from", "waymo")


@pytest.mark.parametrize(
    "name", ["../../secret.bin", "{0}", "samples/../../secret.bin", "samples/LIDAR_TOP/../../../secret.bin"]
)
def test_a_table_names_no_file_outside_its_dataset(name: str, tmp_path: Path) -> None:
    source = write_nuscenes(tmp_path / "a" / "nuscenes")
    secret = tmp_path / "secret.bin"
    secret.write_bytes(b"\0" * 400)
    (tmp_path / "a" / "secret.bin").write_bytes(b"\0" * 400)
    path = source / "v1.0-mini" / "sample_data.json"
    rows = json.loads(path.read_text())
    rows.append({**rows[0], "token": "evil", "filename": name.format(secret)})
    path.write_text(json.dumps(rows))
    imported = drop_unwritable(read_nuscenes(source))
    assert len(imported.frames) == 1 and imported.left_out.counts["frames"] == 1
    assert "no file below" in imported.left_out.lines()[0]


@pytest.mark.parametrize(
    ("table", "key", "value"),
    [
        ("sample_annotation", "size", [1, 2, 10**400]),
        ("sample_annotation", "translation", [1e300, 0, 0]),
        ("sample_annotation", "translation", None),
        ("sample_annotation", "rotation", ["1", "0", "0", "0"]),
        ("sample_annotation", "instance_token", {"token": "i"}),
        ("sample_annotation", "sample_token", 7),
        ("instance", "category_token", ["k"]),
        ("category", "name", "\n"),
    ],
)
def test_one_bad_row_of_nuscenes_costs_itself(table: str, key: str, value: Any, tmp_path: Path) -> None:
    source = write_nuscenes(tmp_path)
    path = source / "v1.0-mini" / f"{table}.json"
    rows = json.loads(path.read_text())
    rows[0][key] = value
    path.write_text(json.dumps(rows))
    imported = drop_unwritable(read_nuscenes(source))
    assert [frame.records.types for frame in imported.frames] == [("animal",)]
    assert imported.left_out.counts["boxes"] == 1


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
    assert re.search(r"boxes: 1, the first: .*annotations\.feather, row 0", imported.left_out.lines()[0])


@pytest.mark.parametrize("name", [" 000001", "000001 ", "00\n0001", "00\u20280001", "\ufeff000001", "00\\0001"])
def test_scans_whose_names_no_list_can_hold_are_left_out(name: str, tmp_path: Path) -> None:
    own = write_box_dataset(tmp_path / "own", 3)
    labels = tmp_path / "labels"
    labels.mkdir()
    (own / "scans" / "000001.bin").rename(own / "scans" / f"{name}.bin")
    for frame_id in ("000000", name, "000002"):
        (labels / f"{frame_id}.json").write_text('{"boxes": []}')
    output = invoke("import", labels, tmp_path / "out", "--scans", own / "scans")
    assert "left out, frames: 1, the first: " in output
    split = BoxSplit(tmp_path / "out")
    assert split.frame_ids == ("000000", "000002")
    for listed in ("train", "val"):
        assert set(BoxSplit(tmp_path / "out", listed).frame_ids) <= set(split.frame_ids)


def test_boxes_that_could_not_be_read_again_are_left_out(tmp_path: Path) -> None:
    """Read as they stand, they are fine; four decimals make nothing of one, and a million of the other."""
    own = write_box_dataset(tmp_path / "own", 1)
    rows = ["scan,class,x,y,z,length,width,height,yaw"]
    rows += [
        "000000.bin,Car,9,0,0,4,2,0.00004,0",
        "000000.bin,Car,999999.99999,0,0,4,2,1,0",
        "000000.bin,Car,9,0,0,4,2,1,6.2",
    ]
    (tmp_path / "boxes.csv").write_text("\n".join(rows))
    output = invoke("import", tmp_path / "boxes.csv", tmp_path / "out", "--scans", own / "scans")
    assert "boxes: Car 1" in output and "left out, boxes: 2" in output
    np.testing.assert_allclose(BoxSplit(tmp_path / "out").records("000000").boxes[0, 6], 6.2 - 2 * np.pi, atol=1e-4)


def test_labels_that_cannot_be_read_again_replace_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = write_box_dataset(tmp_path / "own", 2)
    source = (own / "labels.jsonl", tmp_path / "out", "--scans", own / "scans")
    invoke("import", *source)
    before = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()}
    monkeypatch.setattr(
        "asca_pillars.data.importing.imported.json_line",
        lambda scan, *_: json.dumps({"scan": scan, "boxes": []}) + "\n",
    )
    with pytest.raises(DatasetError, match="cannot be read again"):
        invoke("import", *source)
    assert {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()} == before
