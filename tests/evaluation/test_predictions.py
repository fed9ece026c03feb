"""Folders of KITTI text to be scored: what is paired, what is said, and what is refused in one line."""

from pathlib import Path

import numpy as np
import pytest

from asca_pillars.base.errors import DatasetError
from asca_pillars.data.kitti import KittiSplit, read_labels
from asca_pillars.detection.detections import Detections
from asca_pillars.evaluation.predictions import read_predictions, read_truth, write_predictions
from tests.helpers.scenes import make_scene, write_dataset

CAR = "Car -1 -1 -1.57 600.00 150.00 650.00 200.00 1.50 1.60 3.90 1.00 1.70 20.00 -1.57"


def write(folder: Path, files: dict[str, str]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / f"{name}.txt").write_text(text)
    return folder


def score(tmp_path: Path, predictions: dict[str, str], labels: dict[str, str] | None = None):
    labels = dict.fromkeys(("000001", "000002", "000003"), CAR) if labels is None else labels
    label_folder = write(tmp_path / "gt", labels)
    return read_predictions(write(tmp_path / "det", predictions), read_truth(label_folder), label_folder)


def refusal(tmp_path: Path, predictions: dict[str, str], labels: dict[str, str] | None = None) -> str:
    """The one line, without the folder of the test."""
    with pytest.raises(DatasetError) as caught:
        score(tmp_path, predictions, labels)
    message = str(caught.value)
    assert "\n" not in message
    return message.replace(f"{tmp_path}/", "")


def test_frames_are_paired_by_name_and_in_order(tmp_path: Path) -> None:
    frames = score(tmp_path, {"000003": "", "000001": f"{CAR} 0.5\n\ncYcList{CAR[3:]} -7.25\n", "000002": f"{CAR} 1"})
    assert [frame.frame_id for frame in frames.truth] == ["000001", "000002", "000003"]
    assert [frame.frame_id for frame in frames.detections] == ["000001", "000002", "000003"]
    assert [len(frame) for frame in frames.detections] == [2, 1, 0]
    np.testing.assert_array_equal(frames.detections[0].scores, [0.5, -7.25])
    assert frames.shortage is None and frames.requested == len(frames) == 3


def test_frames_without_a_prediction_file_are_left_out_and_named(tmp_path: Path) -> None:
    frames = score(tmp_path, {"000002": f"{CAR} 0.5"})
    assert [frame.frame_id for frame in frames.truth] == ["000002"]
    assert frames.without_predictions == ("000001", "000003") and frames.requested == 3
    assert frames.shortage == (
        "evaluated on 1 of 3 frames: no prediction file for 000001 and 1 other; "
        "a frame without detections needs an empty file"
    )
    write(tmp_path / "det", {"000003": ""})
    one_missing = read_predictions(tmp_path / "det", read_truth(tmp_path / "gt"), tmp_path / "gt")
    assert one_missing.shortage is not None
    assert "2 of 3 frames: no prediction file for 000001; a frame" in one_missing.shortage


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (CAR, "det/000001.txt:3: 15 fields, but a prediction has 16; append the score at the end of the line"),
        ("Car 0.5", "det/000001.txt:3: 2 fields; a KITTI object label has 15 and a detection 16; convert the file"),
        (f"{CAR} nan", "det/000001.txt:3: 'nan' is not a number; correct the line"),
        (f"{CAR.replace('20.00', '-inf')} 0.5", "det/000001.txt:3: '-inf' is not a number; correct the line"),
        (f"{CAR.replace('20.00', '1e308')} 0.5", "det/000001.txt:3: '1e308' is too large; correct the line"),
        (f"{CAR.replace('20.00', '2O.OO')} 0.5", "det/000001.txt:3: '2O.OO' is not a number; correct the line"),
    ],
)
def test_a_bad_line_is_named(tmp_path: Path, line: str, message: str) -> None:
    assert refusal(tmp_path, {"000001": f"{CAR} 0.5\n\n{line}\n", "000002": ""}) == message


def test_bad_labels_are_named_too(tmp_path: Path) -> None:
    message = "gt/000001.txt:2: 2 fields; a KITTI object label has 15 and a detection 16; convert the file"
    assert refusal(tmp_path, {"000001": ""}, {"000001": "\nCar 0.5"}) == message


def test_types_that_kitti_does_not_have_are_counted(tmp_path: Path) -> None:
    labels = {"000001": f"{CAR}\nForklift{CAR[3:]}\nvan{CAR[3:]}", "000002": f"FORKLIFT{CAR[3:]}"}
    found = {"000001": f"Bus{CAR[3:]} 0.5", "000002": f"forklift{CAR[3:]} 0.5"}
    assert score(tmp_path, found, labels).foreign_types == {"Bus": (0, 1), "Forklift": (2, 1)}
    assert score(tmp_path, {"000001": "", "000002": ""}, dict.fromkeys(labels, CAR)).foreign_types == {}


def test_a_prediction_without_labels(tmp_path: Path) -> None:
    assert refusal(tmp_path, {"000001": "", "000009": "", "000010": ""}) == (
        "det/000009.txt: a prediction without labels, there is no gt/000009.txt (2 such); remove it or add the labels"
    )


def test_folders_that_do_not_belong_together(tmp_path: Path) -> None:
    assert refusal(tmp_path, {"a": "", "b": ""}) == (
        "det: none of its 2 files is of a frame to be evaluated, as 000001.txt would be; "
        "give files the names of those in gt"
    )


def test_empty_and_missing_folders(tmp_path: Path) -> None:
    assert refusal(tmp_path, {}) == "det: no *.txt predictions there; give the folder with <frame id>.txt"
    write(tmp_path / "det" / "data", {"000001": ""})
    assert refusal(tmp_path, {}) == "det: no *.txt predictions there; its folder data/ has some, give that"
    with pytest.raises(DatasetError, match=r"none: cannot read this folder of labels \(No such file or directory\)"):
        read_truth(tmp_path / "none")
    (tmp_path / "det" / "000001.txt").mkdir()
    assert "det/000001.txt: cannot read the labels (Is a directory)" in refusal(tmp_path, {})


def test_predictions_of_another_split_are_left_out(tmp_path: Path) -> None:
    labels = write(tmp_path / "gt", dict.fromkeys(("000001", "000002"), CAR))
    predictions = write(tmp_path / "det", dict.fromkeys(("000001", "000002"), f"{CAR} 0.5"))
    frames = read_predictions(predictions, read_truth(labels, ["000002"]), labels)
    assert [frame.frame_id for frame in frames.truth] == ["000002"] and frames.shortage is None


def test_a_detector_is_run_on_what_the_camera_sees(tmp_path: Path) -> None:
    """A detector that returns the labels of frame 1, and one box beside the camera's view."""
    root = write_dataset(tmp_path / "kitti", 3, val_frames=2)
    _, boxes, names = make_scene(1)
    beside = np.array([[2.0, 9, -1, 3.9, 1.6, 1.5, 0]], np.float32)
    class_names = ("Car", "Pedestrian", "Cyclist")
    labels = np.array([class_names.index(name) for name in names] + [0])
    found = Detections(np.concatenate([boxes, beside]), np.linspace(0.9, 0.5, 5, dtype=np.float32), labels, class_names)
    seen = []

    def detect(points):
        seen.append(len(points))
        return found

    for camera_view in (True, False):
        write_predictions(tmp_path / "det", KittiSplit(root, "val"), detect, camera_view=camera_view)
    assert seen[2:] == [len(make_scene(seed)[0]) for seed in (1, 2)] and seen[0] < seen[2]
    assert sorted(path.name for path in (tmp_path / "det").iterdir()) == ["000001.txt", "000002.txt"]
    written, truth = (read_labels(tmp_path / name / "000001.txt") for name in ("det", "kitti/training/label_2"))
    assert [item.type for item in written] == list(names)
    for one, other in zip(written, truth, strict=True):
        assert (one.x_m, one.y_m, one.z_m, one.rotation_y) == (other.x_m, other.y_m, other.z_m, other.rotation_y)
    assert [item.score for item in written] == pytest.approx([0.9, 0.8, 0.7, 0.6])
