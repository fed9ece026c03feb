"""Labels of labelling tools: written and read again they are the same, and what is not of a format is named."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from asca_pillars.base.errors import ConfigError, DatasetError, OutputError
from asca_pillars.data.boxes.box_records import BoxRecords, json_line, records_from
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.importing.formats import FORMATS, TOOLS
from asca_pillars.data.importing.imported import Imported, drop_unwritable
from asca_pillars.data.importing.tool_labels import WRITTEN_FILE, ScanLabels, require_unchanged, write_prelabels
from asca_pillars.scans.scan_reader import write_scan
from asca_pillars.scans.scan_settings import ScanSettings
from tests.helpers.in_process import invoke

BOX = np.array([[10.0, 1.0, -1.0, 4.1, 1.7, 1.5, 1.2]])


def lengths(least: float, most: float) -> st.SearchStrategy[float]:
    """Numbers of four decimals, as boxes are written."""
    return st.integers(round(least * 10_000), round(most * 10_000)).map(lambda number: number / 10_000)


POSITION, SIZE, YAW = lengths(-300, 300), lengths(0.001, 30), lengths(-3.1415, 3.1415)
FRAME = st.lists(st.tuples(*[POSITION] * 3, *[SIZE] * 3, YAW, st.sampled_from(["Car", "Fork-lift", "Ü"])), max_size=6)


def write_files(root: Path, tool: str, frames: dict[str, BoxRecords]) -> Path:
    labels = [ScanLabels(root / "scans" / f"{name}.bin", Path(name), records) for name, records in frames.items()]
    for frame in labels:
        write_scan(frame.scan, np.ones((1, 4), np.float32))
    for relative, text in FORMATS[tool].files(labels).items():
        path = root / tool / relative
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return root / tool


def read(source: Path, tool: str) -> Imported:
    return FORMATS[tool].read(source, out=source, scans=source.parent / "scans", settings=ScanSettings())


@pytest.mark.parametrize("tool", TOOLS)
@given(frames=st.lists(FRAME, min_size=1, max_size=3))
@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_written_is_read_again_to_the_last_digit(
    tool: str, frames: list[list], tmp_path_factory: pytest.TempPathFactory
) -> None:
    stated = {
        f"{number:06d}": records_from(np.array([row[:7] for row in rows]), [row[7] for row in rows])
        for number, rows in enumerate(frames)
    }
    found = read(write_files(tmp_path_factory.mktemp("labels"), tool, stated), tool)
    assert len(found.frames) == len(stated)
    for frame in found.frames:
        again = frame.records._replace(track_ids=(None,) * len(frame.records.types))
        assert json_line("", again) == json_line("", stated[frame.scan.stem])


@pytest.mark.parametrize("tool", ["sustechpoints", "supervisely", "cvat"])
def test_tracks_are_kept(tmp_path: Path, tool: str) -> None:
    both = records_from(np.repeat(BOX, 2, 0), ["Car", "Car"], None, ["7", None])
    frames = {"a/1": both, "b/1": records_from(BOX, ["Car"], None, ["7"])}
    found = read(write_files(tmp_path, tool, frames), tool)
    assert {frame.recording: frame.records.track_ids for frame in found.frames} == {"a": ("7", "8"), "b": ("7",)}


def test_conventions(tmp_path: Path) -> None:
    """One car, 4.1 m long, that looks 1.2 rad to the left of ahead, as each tool states it in its documentation."""

    def vector(x: float, y: float, z: float, keys: tuple[str, str, str] = ("x", "y", "z")) -> dict[str, float]:
        return dict(zip(keys, (x, y, z), strict=True))

    def sly(size: dict[str, float], yaw: float) -> str:
        geometry = {"position": vector(10, 1, -1), "dimensions": size, "rotation": vector(0, 0, yaw)}
        figure = {"key": "f", "objectKey": "k", "geometryType": "cuboid_3d", "geometry": geometry}
        return json.dumps({"objects": [{"key": "k", "classTitle": "Car", "tags": []}], "figures": [figure]})

    psr = {"position": vector(10, 1, -1), "scale": vector(4.1, 1.7, 1.5), "rotation": vector(0, 0, 1.2)}
    cloud = {"name": "Car", "centroid": vector(10, 1, -1), "rotations": vector(0, 0, math.degrees(1.2))}
    cloud |= {"dimensions": vector(4.1, 1.7, 1.5, ("length", "width", "height"))}
    texts = {
        "labelcloud/0.json": json.dumps({"objects": [cloud]}),
        "sustechpoints/label/0.json": json.dumps([{"obj_id": "1", "obj_type": "Car", "psr": psr}]),
        "supervisely/d/ann/0.pcd.json": sly(vector(1.7, 4.1, 1.5), 1.2 - math.pi / 2),
        "cvat/ds0/ann/0.pcd.json": sly(vector(4.1, 1.7, 1.5), 1.2),
        "openpcdet/labels/0.txt": "10 1 -1 4.1 1.7 1.5 1.2 Car\n",
        "kitti-no-camera/0.txt": "Car 0 0 0 0 0 0 0 1.5 1.7 4.1 10 1 -1 1.2\nDontCare 0 0 0 0 0 0 0 -1 -1 -1 0 0 0 0",
    }
    write_scan(tmp_path / "scans" / "0.bin", np.ones((1, 4), np.float32))
    assert {relative.partition("/")[0] for relative in texts} == set(TOOLS)
    for relative, text in texts.items():
        tool = relative.partition("/")[0]
        (tmp_path / relative).parent.mkdir(parents=True)
        (tmp_path / relative).write_text(text)
        (frame,) = read(tmp_path / tool, tool).frames
        np.testing.assert_allclose(frame.records.boxes, BOX.astype(np.float32), atol=1e-6, err_msg=tool)
        assert frame.records.types == ("Car",)


@pytest.mark.parametrize("tool", [tool for tool in TOOLS if tool != "labelcloud"])
def test_degrees_cannot_pass_for_radians(tmp_path: Path, tool: str) -> None:
    source = write_files(tmp_path, tool, {"0": records_from(BOX, ["Car"])})
    stated = "-0.3707" if tool == "supervisely" else "1.2"
    (path,) = [one for one in source.rglob("*") if one.suffix in (".json", ".txt") and stated in one.read_text()]
    path.write_text(path.read_text().replace(stated, "95.1"))
    with pytest.raises(DatasetError, match=r"yaw is 95\.1\d*, more than a full turn .*degrees by pi / 180"):
        read(source, tool)


def test_radians_cannot_pass_for_degrees(tmp_path: Path) -> None:
    source = write_files(tmp_path, "labelcloud", {"0": records_from(BOX, ["Car"])})
    path, classes = source / "0.json", source / "_classes.json"
    content, text = json.loads(path.read_text()), classes.read_text()
    content["objects"][0]["rotations"]["z"] = -1.25
    path.write_text(json.dumps(content))
    for form, message in (
        ("centroid_abs", r"rotation of -1\.25, and centroid_abs has 0 to 360 .*centroid_rel"),
        ("vertices", r"_classes\.json: the format vertices; set centroid_abs"),
    ):
        classes.write_text(text.replace("centroid_abs", form))
        with pytest.raises(DatasetError, match=message):
            read(source, "labelcloud")
    classes.write_text(text.replace("centroid_abs", "centroid_rel"))
    assert read(source, "labelcloud").frames[0].records.boxes[0, 6] == pytest.approx(-1.25)


@pytest.mark.parametrize(
    ("tool", "text", "message"),
    [
        ("labelcloud", "{", "not valid JSON"),
        ("labelcloud", "[]", "no `objects`"),
        ("labelcloud", '{"objects": [{"name": "Car", "vertices": []}]}', "has vertices; set the label format"),
        ("sustechpoints", "{}", "no list of boxes"),
        ("sustechpoints", '[{"psr": {"position": {"x": 1, "y": 2}}}]', "no `rotation`"),
        ("supervisely", "{}", "no `objects`"),
        ("cvat", '{"objects": []}', "no `figures`"),
        ("openpcdet", "1 2 3 4 5 6 0", "line 1: 7 fields, not x y z"),
        ("openpcdet", "1 2 3 4 5 6 zero Car", "line 1: could not convert"),
        ("openpcdet", "1 2 3 4 nan 6 0 Car", "box 1: the size is"),
        ("kitti-no-camera", "\nCar 0", "line 2: 2 fields, KITTI's have 15"),
    ],
)
def test_a_mistake_is_named(tmp_path: Path, tool: str, text: str, message: str) -> None:
    write_scan(tmp_path / "scans" / "0.bin", np.ones((1, 4), np.float32))
    path = tmp_path / "labels" / ("0.txt" if tool in ("openpcdet", "kitti-no-camera") else "0.json")
    path.parent.mkdir()
    path.write_text(text)
    with pytest.raises(DatasetError, match=f"{path.name}: .*{message}"):
        read(path.parent, tool)


def test_labels_and_scans_belong_together_by_name(tmp_path: Path) -> None:
    frames = {"a/1": records_from(BOX, ["Car"]), "b/1": records_from(BOX + 1, ["Car"])}
    source = write_files(tmp_path, "openpcdet", frames)
    found = {frame.recording: frame.records.boxes[0, 0] for frame in read(source, "openpcdet").frames}
    assert found == {"a": 10, "b": 11}
    for name, tool, message in (
        ("2.txt", "openpcdet", r"2\.txt: belongs to one scan 2\.\* .*, there is none; correct"),
        ("1.txt", "openpcdet", r"1\.txt: belongs to one scan"),
        ("1.txt", "sustechpoints", r"no \*\.json with labels there"),
    ):
        (source / name).write_text("")
        with pytest.raises(DatasetError, match=message):
            read(source, tool)
        (source / name).unlink()


def test_what_a_format_cannot_hold(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"class 'Big one': these labels are separated by blanks"):
        write_files(tmp_path, "openpcdet", {"0": records_from(BOX, ["Big one"])})
    (tmp_path / "export").mkdir()
    (tmp_path / "export" / "tracklet_labels.xml").write_text("")
    with pytest.raises(DatasetError, match=r"tracklets; export as Sly Point Cloud Format 1\.0"):
        read(tmp_path / "export", "cvat")


def test_tilted_boxes_are_upright_and_counted(tmp_path: Path) -> None:
    source = write_files(tmp_path, "sustechpoints", {"0": records_from(BOX, ["Car"])})
    (path,) = source.rglob("0.json")
    content = json.loads(path.read_text())
    content[0]["psr"]["rotation"]["x"] = 0.2
    path.write_text(json.dumps(content))
    found = drop_unwritable(read(source, "sustechpoints"))
    assert len(found.frames[0].records.types) == 1
    assert "box 1: rolled or pitched by 0.2 rad, read upright" in found.skipped.lines()[0]


def test_corrections_are_not_replaced(tmp_path: Path) -> None:
    scan, run = tmp_path / "scans" / "0.bin", tmp_path / "detections.jsonl"
    write_scan(scan, np.ones((1, 4), np.float32))
    run.write_text(json_line(str(scan), records_from(BOX, ["Car"])))
    label = write_prelabels(run, "openpcdet", tmp_path) / "0.txt"
    assert label.read_text() == "10.0000 1.0000 -1.0000 4.1000 1.7000 1.5000 1.2000 Car\n"
    run.write_text(json_line(str(scan), records_from(BOX, ["Van"])))
    for tool in ("labelcloud", "openpcdet"):
        write_prelabels(run, tool, tmp_path)
    assert "Van" in label.read_text()
    label.write_text("corrected")
    with pytest.raises(OutputError, match=r"0\.txt: was changed or added since .* may hold corrections"):
        write_prelabels(run, "openpcdet", tmp_path)
    assert label.read_text() == "corrected"
    require_unchanged(tmp_path, "labelcloud")
    (tmp_path / WRITTEN_FILE).write_text("")
    with pytest.raises(OutputError, match="was changed or added"):
        require_unchanged(tmp_path, "labelcloud")


def test_detect_correct_and_import(tmp_path: Path) -> None:
    out, scans = tmp_path / "out", tmp_path / "scans"
    keys = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad")
    importing = ("import", out / "labelcloud", tmp_path / "data", "--scans", scans)
    with pytest.raises(ConfigError, match=r"--write best: no such format; available: labelcloud, "):
        invoke("detect", "--out", out, "--write", "best", "--no-pictures")
    invoke("detect", "--out", out, "--write", "labelcloud", "--no-pictures")
    detected = json.loads((out / "detections.jsonl").read_text())
    write_scan(scans / f"{Path(detected['scan']).stem}.bin", np.ones((9, 4), np.float32))
    output = invoke(*importing, "--from", "labelcloud")
    assert f"Car {sum(box['class'] == 'Car' for box in detected['boxes'])}" in output
    split = BoxSplit(tmp_path / "data", "train")
    found = split.records(split.frame_ids[0]).boxes
    np.testing.assert_allclose(found, [[box[key] for key in keys] for box in detected["boxes"]], atol=5e-5)
    with pytest.raises(ConfigError, match=r"--from nope: no such format; available: boxes, labelcloud, "):
        invoke(*importing, "--from", "nope")
