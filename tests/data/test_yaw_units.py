"""Yaws in degrees: one beyond a turn is refused, many whole ones are doubted, wherever labels are read."""

import json
from pathlib import Path

import numpy as np
import pytest

from asca_pillars.base.errors import DatasetError
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import Config, DataConfig
from asca_pillars.data.kitti import parse_object, read_labels
from asca_pillars.data.open_split import open_split
from asca_pillars.data.require_boxes import require_boxes
from asca_pillars.data.yaw_units import check_yaws
from asca_pillars.geometry.boxes import wrap_angle
from tests.data.boxes.box_scenes import write_box_dataset
from tests.helpers.in_process import invoke
from tests.helpers.scenes import SPEC, write_dataset

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
    with pytest.raises(DatasetError, match=rf"a\.txt:2: rotation_y is {yaw}, .* radians .* pi / 180"):
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
    assert "all 6 yaws that are not 0 are whole numbers, such as 5: radians are wanted" in output
    output = invoke("eval", "--data", own, "--split", "training", "--predictions", boxes, "-o", tmp_path / "scores")
    assert "predictions: all 6 yaws" in output and "labels: all" not in output
