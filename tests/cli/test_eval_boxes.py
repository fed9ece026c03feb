"""`asca eval` on a dataset without a camera: what is written, that it scores the same again, and what is refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_deploy import Detections, Detector, sample_scan_path
from asca_pillars.base.errors import AscaError
from asca_pillars.data.boxes.box_records import json_line, read_frames, records_from
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.evaluation.arguments import Model
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_reader import read_scan, write_scan
from tests.data.boxes.box_scenes import write_box_dataset
from tests.helpers.earlier_evaluation import earlier_predictions
from tests.helpers.in_process import invoke
from tests.helpers.scenes import write_dataset


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_box_dataset(tmp_path / "own", 3, val_frames=2)


@pytest.fixture
def perfect(root: Path) -> Path:
    """The labels of all frames as predictions, written as elsewhere."""
    path = root.parent / "found.jsonl"
    lines = (root / "labels.jsonl").read_text().replace('"scan": "', '"scan": "/data/')
    path.write_text(lines.replace(', "yaw', ', "score": 0.9, "yaw'))
    return path


def test_labels_as_predictions_are_perfect_by_iou_and_distance(root: Path, perfect: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    earlier_predictions(out)
    (out / "notes.txt").write_text("my own")
    output = invoke("eval", "--data", root, "--predictions", perfect, "--out", out)  # iou: there is no camera
    names = {path.name for path in out.iterdir()}
    assert names == {"iou.json", "iou.md", "notes.txt"}, "an earlier model's predictions do not stay"
    assert "AP by 3D and BEV IoU" in output and "2 frames" in output
    report = json.loads((out / "iou.json").read_text())
    assert {score["class_name"] for score in report["iou"]} == {"Car", "Forklift"}
    assert {score["ap"] for score in report["iou"] if score["band"] == "all"} == {100.0}
    options = ("--protocol", "distance", "--json", tmp_path / "d.json")
    invoke("eval", "--data", root, "--predictions", perfect, "--out", out, *options)
    report = json.loads((tmp_path / "d.json").read_text())
    assert report == json.loads((out / "distance.json").read_text())
    assert [round(score["cds"]) for score in report["argoverse2"]] == [100, 100]
    assert "| Forklift |" in (out / "distance.md").read_text()


def test_a_model_is_run_and_scores_the_same_again(root: Path, tmp_path: Path) -> None:
    first = tmp_path / "first"
    output = invoke("eval", "fast", "--data", root, "--out", first, "--min-score", 0.001)  # it knows no made-up scenes
    assert "Labelled, but no class that is evaluated: Forklift (2)" in output
    report = json.loads((first / "iou.json").read_text())
    assert [score["objects"] for score in report["at_score"] if score["band"] == "all"] == [2, 0, 0]
    invoke("eval", "--data", root, "--predictions", first / "predictions", "--out", tmp_path / "second")
    again = json.loads((tmp_path / "second" / "iou.json").read_text())
    of_car = [[score for score in one["iou"] if score["class_name"] == "Car"] for one in (report, again)]
    assert of_car[0] == of_car[1] and len(of_car[0]) > 0
    invoke("eval", "fast", "--data", root, "--out", first)  # replaces its own


def test_a_note_says_which_labels_lie_outside_the_detectors_ranges(root: Path, perfect: Path, tmp_path: Path) -> None:
    lines = [json.loads(line) for line in perfect.read_text().splitlines()]
    boxes = [box for line in lines if line["scan"].endswith(("1.bin", "2.bin")) for box in line["boxes"]]
    ahead = sum(0 <= box["x_m"] < 20 and -10 <= box["y_m"] < 10 for box in boxes)
    assert 0 < ahead < len(boxes)
    scopes: dict[str, dict[str, Any]] = {
        "do not state the detector's ranges": {},
        f"{len(boxes) - ahead} of {len(boxes)} labelled boxes": {"ranges_m": [[0, 20], [-10, 10]]},
        "": {"ranges_m": None},
    }
    for text, scope in scopes.items():
        detector = {"detector": {"classes": ["Car", "Forklift"], **scope}}
        perfect.write_text("".join(json.dumps(line | detector) + "\n" for line in lines))
        invoke("eval", "--data", root, "--predictions", perfect, "--out", tmp_path / "out")
        report = json.loads((tmp_path / "out" / "iou.json").read_text())
        said = [note for note in report["notes"] if "detector's ranges" in note]
        assert [text in note for note in said] == [True] * bool(text)
        assert {score["ap"] for score in report["iou"] if score["band"] == "all"} == {100.0}


def test_scans_of_another_mounting_are_brought_to_the_models(tmp_path: Path) -> None:
    """The sample, x to the right and z = 0 on the ground: predictions are in the scans' own frame, as labels are."""
    sample = read_scan(sample_scan_path()).points[::2]
    mounting = Mounting(axes="y-forward")
    lift = np.array([0, 0, 1.7, 0], np.float32)
    found = []
    for name, points, text in (
        ("plain", sample, "sensor_height: 1.7\n"),
        ("other", mounting.level.inverse.points(sample) + lift, "{sensor_height: 0.0, axes: y-forward}\n"),
    ):
        root = tmp_path / name
        write_scan(root / "scans" / "1.bin", points)
        box = np.array([[12.0, 3, -1, 4, 1.6, 1.5, 0.3]])
        own = box if name == "plain" else mounting.level.inverse.boxes(box) + np.array([0, 0, 1.7, 0, 0, 0, 0])
        (root / "labels.jsonl").write_text(json_line("1.bin", records_from(own, ["Car"])))
        (root / "dataset.yaml").write_text(text)
        out = tmp_path / f"{name}_out"
        invoke("eval", "fast", "--data", root, "--split", "training", "--out", out, "--around")
        ((_, records, *_),) = read_frames(out / "predictions" / "detections.jsonl")
        found.append(records)
    plain, other = found
    sure = plain.scores > 0.5
    here = mounting.level.inverse.boxes(plain.boxes[sure])[:, :3] + lift[:3]
    assert sure.sum() > 8 and (plain.boxes[sure, 0] < -5).any()
    assert (np.linalg.norm(here[:, None] - other.boxes[None, :, :3], axis=2).min(axis=1) < 0.2).all()


@pytest.mark.parametrize("camera_view", [True, False])
def test_a_model_gets_the_points_that_it_was_trained_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, camera_view: bool
) -> None:
    root, given = write_dataset(tmp_path / "kitti", 2), []
    sample = Detector("fast")

    def detect(points: NDArray[np.float32]) -> Detections:
        given.append(len(points))
        return sample(points)

    model = Model("any", detect, sample.spec, camera_view, {})
    monkeypatch.setattr("asca_deploy.evaluate.open_model", lambda *_, **__: model)
    invoke("eval", "--data", root, "--out", tmp_path / "out", "--protocol", "distance")
    split = KittiSplit(root, "val")
    assert given == [len(split.points(one, camera_view=camera_view)) for one in split.frame_ids]
    assert (given == [len(split.points(one, camera_view=False)) for one in split.frame_ids]) is not camera_view
    report = json.loads((tmp_path / "out" / "distance.json").read_text())
    objects = {score["class_name"]: score["objects"] for score in report["argoverse2"]}
    assert objects == {"Car": 2, "Pedestrian": 1, "Cyclist": 1}


def test_what_lies_where_nothing_is_labelled_is_neither_right_nor_wrong(
    root: Path, perfect: Path, tmp_path: Path
) -> None:
    """Labels within 40 degrees ahead; predictions everywhere."""
    boxes = np.array([[20, 0, 0, 4, 2, 1.5, 0], [0, 20, 0, 4, 2, 1.5, 0], [20, 7.5, 0, 4, 2, 1.5, 0]], np.float32)
    write_scan(root / "scans" / "000001.bin", np.hstack([boxes[:, :3], np.zeros((3, 1))]).astype(np.float32))
    line = json_line("scans/000001.bin", records_from(boxes[[0, 2]], ("Car",) * 2))
    (root / "labels.jsonl").write_text(line)
    (root / "dataset.yaml").write_text(f"{(root / 'dataset.yaml').read_text()}\nlabeled_view_deg: 40\n")
    boxes[2, 1] += 0.2  # its label stands at the edge
    perfect.write_text(json_line("scans/000001.bin", records_from(boxes, ("Car",) * 3, (0.9,) * 3)))
    invoke("eval", "--data", root, "--split", "training", "--predictions", perfect, "--out", tmp_path / "out")
    report = json.loads((tmp_path / "out" / "iou.json").read_text())
    assert {score["ap"] for score in report["iou"] if score["band"] == "all" and score["min_iou"] < 0.7} == {100.0}
    with pytest.raises(AscaError, match="has labels within an angle ahead alone"):
        invoke("eval", "--data", root, "--split", "training", "--around", "--out", tmp_path / "out")


def test_frames_without_predictions_are_named_and_classes_have_something_in_common(
    root: Path, perfect: Path, tmp_path: Path
) -> None:
    perfect.write_text("".join(line for line in perfect.read_text().splitlines(keepends=True) if "000001" in line))
    assert "evaluated on 1 of 2 frames: no predictions for 000002" in " ".join(
        invoke("eval", "--data", root, "--predictions", perfect, "--out", tmp_path / "out").split()
    )
    perfect.write_text(perfect.read_text().replace("Car", "auto").replace("Forklift", "truck"))
    with pytest.raises(AscaError, match="labels are of Car, Forklift, predictions of auto, truck: no class in common"):
        invoke("eval", "--data", root, "--predictions", perfect, "--out", tmp_path / "none")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--protocol iou", "needs the labels: give --data"),
        ("--protocol kitti --data {root}", "has no camera, which it needs; choose iou or distance"),
        ("--data {root} --around --predictions x", "--around runs a model"),
        ("--data {root} --around --protocol waymo", "--around needs labels in every direction"),
        ("run.ckpt --data {root} --around", "--around runs bundles: export the checkpoint first"),
        ("--data {root} --gallery 3", "--gallery 3 belongs to --protocol kitti"),
        ("--data {root} --labels x", "--labels x belongs to"),
        ("--data {root} --min-score 0.9", "of Car is below --min-score 0.9"),
        ("--data {root} --score 0.01", "score 0.01 of Car is below --min-score 0.05"),
        ("--data {root} --score 5", "--score 5: scores of a model are at most 1"),
        ("--data {root} --predictions x --provider y", "--provider y is for running a model"),
        ("--data {root} --predictions x --precision y", "--precision y is for running a model"),
        ("--data {root} --predictions x --min-score 0.9", "--min-score 0.9 is for running a model"),
        ("--data {root} --predictions x --threads 2", "--threads 2 is for running a model"),
        ("--split training --predictions x --labels y", "--split training is a list of the frames of"),
        ("--data {root} --score nan", "--score nan must be a number"),
        ("--data {root} --predictions {root}/none.jsonl --json {root}", "is a folder"),
        ("--data {root} --predictions {root}/labels.jsonl", "labels.jsonl:2, box 1: no `score`"),
        ("--data {root} --predictions {root}/none.jsonl", "none.jsonl: cannot be read"),
    ],
)
def test_what_cannot_be_is_refused(root: Path, tmp_path: Path, options: str, message: str) -> None:
    with pytest.raises(AscaError) as caught:
        invoke("eval", *options.format(root=root).split(), "--out", tmp_path / "out")
    assert message in str(caught.value) and "\n" not in str(caught.value)
