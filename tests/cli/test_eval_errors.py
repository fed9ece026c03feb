"""`asca eval --errors`: what is written for both layouts, what stands beside it, and what is refused."""

import json
from pathlib import Path
from typing import Any

import pytest

from asca_pillars.base.errors import AscaError
from asca_pillars.data.kitti import write_image_set
from tests.data.boxes.box_scenes import write_box_dataset
from tests.helpers.in_process import invoke

FILES = {"errors.html", "errors.json", "errors.md"}


def names(out: Path) -> set[str]:
    return {path.name for path in out.iterdir()} & FILES


def datasets(out: Path) -> dict[str, dict[str, Any]]:
    content = json.loads((out / "errors.json").read_text())
    return {data["name"]: {one["class_name"]: one for one in data["classes"]} for data in content["datasets"]}


def test_predictions_as_kitti_text(root: Path, texts: dict[str, Any], tmp_path: Path) -> None:
    out = tmp_path / "out"
    given = ("eval", "--predictions", texts["predictions"], "--data", root, "--split", "training", "--out", out)
    printed = invoke(*given, "--errors")
    assert names(out) == FILES and "Car: errors of boxes by view" in printed
    (whole,) = datasets(out).values()
    assert set(whole) == {"Car", "Pedestrian", "Cyclist"}
    everything = whole["Car"]["groups"][0]
    assert (everything["group"], everything["objects"], everything["found"]) == ("all", 6, 6)
    assert everything["residuals"]["far_end"]["middle"] == pytest.approx(0, abs=0.01)
    assert whole["Car"]["reaching"]["as drawn"] == 1 and whole["Car"]["false"]["per_frame"] == 0
    assert "## Car: errors of boxes by distance" in (out / "errors.md").read_text()
    invoke(*given)
    assert names(out) == set(), "an earlier analysis is not of this evaluation"


def test_parts_and_other_evaluations_stand_beside(root: Path, texts: dict[str, Any], tmp_path: Path) -> None:
    given = ("eval", "--predictions", texts["predictions"], "--data", root, "--split", "training", "--errors")
    invoke(*given, "--errors-by", "list", "--out", tmp_path / "first")
    assert list(datasets(tmp_path / "first")) == ["det kitti/training", "det kitti/train", "det kitti/val"]
    write_image_set(root, "apart", ["000000"])
    other = tmp_path / "second"
    printed = invoke(*given, "--errors-by", "6", "--beside", tmp_path / "first" / "errors.json", "--out", other)
    assert list(datasets(other)) == ["det kitti/training", *(f"det kitti/00000{number}" for number in range(3))]
    assert "det kitti/val" in printed and "det kitti/val" in (other / "errors.md").read_text()
    assert "det kitti/val" in (other / "errors.html").read_text()


def test_boxes_without_a_camera(tmp_path: Path) -> None:
    root = write_box_dataset(tmp_path / "own", 3, val_frames=2)
    found = tmp_path / "found.jsonl"
    found.write_text((root / "labels.jsonl").read_text().replace(', "yaw', ', "score": 0.9, "yaw'))
    out = tmp_path / "out"
    invoke("eval", "--data", root, "--predictions", found, "--errors", "--out", out)
    (name, whole), *_ = datasets(out).items()
    assert name == "found.jsonl own/val" and set(whole) == {"Car", "Forklift"}
    assert [one["groups"][0]["found"] for one in whole.values()] == [2, 2]
    assert names(out) == FILES


def test_the_model_that_wrote_the_predictions_is_named(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    invoke("eval", "fast", "--data", root, "--errors", "--out", out)
    assert list(datasets(out)) == ["fast kitti/val"]
    invoke("eval", "--data", root, "--predictions", out / "predictions", "--errors", "--out", tmp_path / "again")
    assert list(datasets(tmp_path / "again")) == ["fast kitti/val"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--errors-by", "list"), "--errors-by list belongs to the error analysis: give --errors, too"),
        (("--beside", "x.json"), "--beside belongs to the error analysis: give --errors, too"),
        (("--errors", "--protocol", "waymo"), "--errors goes with --protocol kitti, iou or distance, not with waymo"),
        (("--errors", "--errors-by", "drive"), "--errors-by drive: give list, or how many characters"),
        (("--errors", "--errors-by", "2"), "--errors-by 2: every frame id begins with 00; give a larger number"),
        (("--errors", "--beside", "none.json"), "none.json: cannot be read"),
        (("--errors", "--errors-by", "list"), "lies within val; write one for each part"),
        (("--errors", "--predictions", "x", "--labels", "y"), "--errors looks at the points of the scans: give --data"),
    ],
)
def test_what_does_not_go_together(root: Path, tmp_path: Path, options: tuple[str, ...], message: str) -> None:
    data = () if "--labels" in options else ("--data", root)
    with pytest.raises(AscaError) as caught:
        invoke("eval", *data, "--out", tmp_path / "out", *options)
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("content", ["[]", "{", '{"subject": "x"}', '{"subject": "x", "datasets": [{}], "about": {}}'])
def test_a_file_beside_that_is_none(root: Path, tmp_path: Path, content: str) -> None:
    path = tmp_path / "errors.json"
    path.write_text(content)
    with pytest.raises(AscaError) as caught:
        invoke("eval", "--data", root, "--errors", "--beside", path, "--out", tmp_path / "out")
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)
