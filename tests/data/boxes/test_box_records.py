"""Records of boxes in JSON and CSV: every form gives the same boxes, and what is wrong is named by file and line.

Yaws in degrees: one beyond a turn is refused, many whole ones are doubted, wherever labels are read.
"""

import json
import re
import textwrap
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asca_pillars.base.errors import DatasetError
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import Config, DataConfig
from asca_pillars.data.boxes.box_records import json_line, read_frame_file, read_frames, records_from
from asca_pillars.data.kitti import parse_object, read_labels
from asca_pillars.data.open_split import open_split
from asca_pillars.data.yaw_units import check_yaws
from asca_pillars.geometry.boxes import wrap_angle
from asca_pillars.training.dataset import require_boxes
from tests.data.boxes.box_scenes import write_box_dataset
from tests.helpers.in_process import invoke
from tests.helpers.scenes import SPEC, write_dataset

BOX = {"class": "Forklift", "x_m": 10, "y_m": -2.5, "z_m": -0.7, "length_m": 2.5, "width_m": 1.2, "height_m": 2.1}
BOX |= {"yaw_rad": 0.3}
ARRAY = np.array([[10, -2.5, -0.7, 2.5, 1.2, 2.1, 0.3]], np.float32)


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_all_forms_give_the_same_boxes(tmp_path: Path) -> None:
    line = json.dumps({"scan": "a.bin", "boxes": [BOX], "frame": "other keys stay out of the way"})
    header, row = "scan,class,x,y,z,length,width,height,yaw", "a.bin,Forklift,10,-2.5,-0.7,2.5,1.2,2.1,0.3"
    found = [
        next(read_frames(write(tmp_path / "labels.jsonl", line + "\n\n"))).records,
        next(read_frames(write(tmp_path / "labels.csv", f"\ufeff{header}\n{row}\n"))).records,
        read_frame_file(write(tmp_path / "a.json", json.dumps({"boxes": [BOX]}))),
        read_frame_file(write(tmp_path / "a.csv", f"{header[5:]}\n{row[6:]}\n")),
    ]
    for records in found:
        assert np.array_equal(records.boxes, ARRAY) and records.types == ("Forklift",)
        assert np.isnan(records.scores).all() and records.track_ids == (None,)


def test_the_examples_of_the_documentation_are_what_they_say(tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "docs" / "DATA.md").read_text(encoding="utf-8")
    blocks = [textwrap.dedent(block) for block in re.findall(r"^  ```\n(.*?)^  ```$", text, re.DOTALL | re.MULTILINE)]
    table, lines = write(tmp_path / "l.csv", blocks[0]), write(tmp_path / "l.jsonl", blocks[1])
    for frame in (next(read_frames(table)), next(read_frames(lines))):
        assert frame.scan == "000000.bin" and frame.records.types == ("Forklift",)
        assert frame.records.boxes[0].tolist() == pytest.approx([12.1, -3.0, -0.7, 2.5, 1.2, 2.1, 0.3])


def test_scores_tracks_and_times_are_kept_and_csv_rows_gathered_by_scan(tmp_path: Path) -> None:
    records = records_from(ARRAY, ["Car"], [0.25], ["7"])
    path = write(tmp_path / "d.jsonl", json_line("b/c.pcd", records, 12.25) + json_line("b.bin", records))
    frames = list(read_frames(path))
    assert [(frame.scan, frame.time_s) for frame in frames] == [("b/c.pcd", 12.25), ("b.bin", None)]
    assert frames[0].records.track_ids == ("7",) and frames[0].records.scores.tolist() == [0.25]
    rows = [f"{scan},Car,{x},0,0,4,2,1.5,0" for x, scan in enumerate("abab")]
    path = write(tmp_path / "labels.csv", "\n".join(["scan,class,x,y,z,length,width,height,yaw", *rows]))
    assert {frame.scan: frame.records.boxes[:, 0].tolist() for frame in read_frames(path)} == {"a": [0, 2], "b": [1, 3]}


@pytest.mark.parametrize("time_s", ["1" + "0" * 400, "1e999", "NaN", '"7"', "true"])
def test_a_time_stamp_that_no_clock_shows_is_none(tmp_path: Path, time_s: str) -> None:
    line = f'{{"scan": "a.bin", "time_s": {time_s}, "boxes": []}}'
    assert [frame.time_s for frame in read_frames(write(tmp_path / "l.jsonl", line))] == [None]


def test_line_breaks_within_a_text_end_no_line(tmp_path: Path) -> None:
    """Other programs write JSON and CSV without escapes."""
    lines = [json.dumps({"scan": f"a\u2028{number}.bin", "boxes": []}, ensure_ascii=False) for number in range(2)]
    frames = read_frames(write(tmp_path / "l.jsonl", "\r\n".join(lines)))
    assert [frame.scan for frame in frames] == ["a\u20280.bin", "a\u20281.bin"]
    text = "scan,class,x,y,z,length,width,height,yaw\r\na\x85b,Car,1,2,0,4,2,1,6.28\r\n"
    (frame,) = read_frames(write(tmp_path / "l.csv", text))
    assert frame.scan == "a\x85b" and frame.records.boxes[0, 6] == pytest.approx(6.28 - 2 * np.pi, abs=1e-6)


@given(st.lists(st.floats(-500, 500), min_size=7, max_size=7))
def test_what_is_written_is_read_again(tmp_path_factory: pytest.TempPathFactory, numbers: list[float]) -> None:
    box = np.array([[*numbers[:3], *(abs(number) + 0.1 for number in numbers[3:6]), numbers[6] % 3]], np.float32)
    path = tmp_path_factory.mktemp("records") / "labels.jsonl"
    path.write_text(json_line("a.bin", records_from(box, ["Car"])))
    assert np.abs(next(read_frames(path)).records.boxes - box).max() < 1e-4


def with_box(**changes: object) -> str:
    return json.dumps({"scan": "a", "boxes": [BOX | changes]})


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("l.jsonl", '{"scan": "a", "boxes": []}\n{"scan"', r"l\.jsonl:2: not valid JSON"),
        ("l.jsonl", '{"boxes": []}', r'l\.jsonl:1: no "scan"'),
        ("l.jsonl", '{"scan": "a"}', r'l\.jsonl:1: no list "boxes"'),
        ("l.jsonl", '{"scan": "a", "boxes": [7]}', r"l\.jsonl:1, box 1: 7 is not a record"),
        ("l.jsonl", json.dumps({"scan": "a", "boxes": [BOX, BOX | {"x_m": "far"}]}), r"1, box 2: x_m is 'far'"),
        ("l.jsonl", with_box(x_m=True), r"box 1: x_m is 'True'"),
        ("l.jsonl", with_box(x_m=10**400), r"box 1: x_m is '1000"),
        ("l.jsonl", with_box(score=-(10**400)), r"box 1: score is '-1000"),
        ("l.jsonl", with_box(yaw_rad=235), r"yaw_rad is 235, .* radians; .* pi / 180"),
        ("l.jsonl", with_box(width_m=0), r"box 1: width_m is 0"),
        ("l.jsonl", with_box(**{"class": " "}), r"box 1: no `class`"),
        ("l.jsonl", '{"scan": "a", "boxes": [{"class": "Car", "x": 1}]}', r"box 1: no `y_m`"),
        ("l.jsonl", '{"scan": "a", "objects": [{"centroid": {}}]}', r"labels of labelCloud; .*--from labelcloud"),
        ("l.csv", "class,x\nCar,1\n", r"l\.csv:2: no `scan`"),
        ("l.csv", "scan,class\na,Car,1\n", r"l\.csv:2: 3 values for 2 columns"),
        ("l.csv", "scan,class,class\na,Car,1\n", r"l\.csv:1: the column `class` is there twice"),
        ("l.csv", "scan;class;x\na;Car;1\n", r"l\.csv:1: columns are separated by semicolons"),
        ("l.csv", 'scan,class\n"' + 200_000 * "a", r"l\.csv:2: not valid CSV \(.*\); close the quotes"),
        ("l.csv", "scan,class,x,x_m\na,Car,1,9\n", r"l\.csv:2: both `x` and `x_m`; remove one"),
        ("l.txt", "", r"l\.txt: labels of several frames are \.jsonl or \.csv"),
    ],
    ids=range(20),
)
def test_a_mistake_is_named(tmp_path: Path, name: str, text: str, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        list(read_frames(write(tmp_path / name, text)))


def test_a_file_of_another_tool_that_is_no_text_or_not_there_is_named(tmp_path: Path) -> None:
    path = write(tmp_path / "000000.json", '[{"psr": {"position": {}}, "obj_type": "Car"}]')
    with pytest.raises(DatasetError, match=r"000000\.json: labels of SUSTechPOINTS; .*--from sustechpoints"):
        read_frame_file(path)
    (tmp_path / "l.jsonl").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DatasetError, match=r"l\.jsonl: not UTF-8"):
        list(read_frames(tmp_path / "l.jsonl"))
    with pytest.raises(DatasetError, match=r"m\.csv: cannot be read"):
        read_frame_file(tmp_path / "m.csv")


CAR = "Car 0 0 0 500 100 600 200 2 1.8 4.5 -3 1.7 12 {yaw}"


@pytest.mark.parametrize("yaws", [[1.0, 2.0, 3.0], [0.0, 0.0, 4.0, 5.0], [[-1.0], [6.0, 6.0]], [3.0, -2.0, 0.0]])
def test_whole_yaws_are_doubted_wrapped_or_not(yaws: list) -> None:
    for own in ([np.array(one) for one in yaws], [wrap_angle(np.array(one, np.float32)) for one in yaws]):
        doubt = check_yaws(own)
        assert doubt is not None and "radians" in doubt and "pi / 180" in doubt


@pytest.mark.parametrize(
    "yaws", [[], [0.0] * 50, [1.0], [0.0, 3.0], [1.0, 2.0, 1.57], [np.pi / 2, -np.pi / 2, np.pi], [0.1, 0.2]]
)
def test_right_yaws_are_not(yaws: list[float]) -> None:
    assert check_yaws(yaws) is None


@pytest.mark.parametrize("yaw", ["90", "-90", "6.5", "235"])
def test_rotation_y_in_degrees_is_refused(yaw: str, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(f"{CAR.format(yaw='1.57')}\n{CAR.format(yaw=yaw)}\n")
    with pytest.raises(DatasetError, match=rf"a\.txt:2: rotation_y is {yaw}, .* radians; .* pi / 180"):
        read_labels(tmp_path / "a.txt")


def test_rotation_y_where_there_is_no_box_is_minus_ten() -> None:
    for line, expected in (
        ("DontCare -1 -1 -10 5 5 9 9 -1 -1 -1 -1000 -1000 -1000 -10", -10),
        ("Car -1 -1 -10 5 5 9 9 -1 -1 -1 0 0 0 -10 1", -10),
        (CAR.format(yaw="-6.2832"), -6.2832),
    ):
        assert parse_object(line.split(), "here").rotation_y == expected


def test_train_and_eval_name_whole_yaws(tmp_path: Path) -> None:
    """In KITTI's layout, whose rotation_y is the last word of a line."""
    root, found = write_dataset(tmp_path / "data", 5), tmp_path / "found"
    found.mkdir()
    for path in (root / "training" / "label_2").glob("*.txt"):
        starts = [line.rpartition(" ")[0] for line in path.read_text().splitlines()]
        whole = [f"{start} {1 + number}.00" for number, start in enumerate(starts)]
        path.write_text("".join(f"{line}\n" for line in whole))
        (found / path.name).write_text("".join(f"{line} 0.9\n" for line in whole))
    config = Config(model=PillarModel(spec=SPEC), data=DataConfig(workers=0))
    (line,) = require_boxes(open_split(root, "train"), config, training=True)
    assert "`train`: all 16 yaws that are not 0 are whole numbers" in line
    output = invoke("eval", "--predictions", found, "--labels", root / "training" / "label_2", "-o", tmp_path / "out")
    for what in ("labels", "predictions"):
        assert f"{what}: all 20 yaws" in output


def test_import_and_eval_of_boxes_name_whole_yaws(tmp_path: Path) -> None:
    own, boxes = write_box_dataset(tmp_path / "own", 3), tmp_path / "boxes.jsonl"
    lines = [json.loads(line) for line in (own / "labels.jsonl").read_text().splitlines()]
    for line in lines:
        for number, box in enumerate(line["boxes"]):
            box |= {"yaw_rad": number + 4, "score": 0.5}
    boxes.write_text("".join(json.dumps(line) + "\n" for line in lines))
    output = invoke("import", boxes, tmp_path / "out", "--scans", own / "scans")
    assert "all 6 yaws that are not 0 are whole numbers, such as 5: yaws must be in radians" in output
    output = invoke("eval", "--data", own, "--split", "training", "--predictions", boxes, "-o", tmp_path / "scores")
    assert "predictions: all 6 yaws" in output and "labels: all" not in output
