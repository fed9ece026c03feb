"""Which frame a line of predictions belongs to."""

import json
from pathlib import Path

import numpy as np
import pytest

from asca_pillars.base.errors import DatasetError
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.evaluation.boxes.box_predictions import predictions_by_frame, read_box_predictions

BOX = {"class": "Car", "y_m": 0, "z_m": 0, "length_m": 4, "width_m": 2, "height_m": 1.5, "yaw_rad": 0, "score": 0.9}
TIMES_S = {f"{number:06d}": 1.7e9 + number / 10 for number in range(6)}


def dataset(root: Path, times_s: dict[str, float] | None, own_files: bool = True) -> BoxSplit:
    """Frames of one car each, with time stamps, in a file each or in one for all; times None: without them."""
    lines = {}
    for number, frame_id in enumerate(times_s or TIMES_S):
        time = {} if times_s is None else {"time_s": times_s[frame_id]}
        lines[frame_id] = json.dumps({"scan": f"{frame_id}.npy", "boxes": [BOX | {"x_m": 10 + number}]} | time)
        for path in (root / "scans" / f"{frame_id}.npy", root / "labels" / f"{frame_id}.json"):
            path.parent.mkdir(parents=True, exist_ok=True)
        np.save(root / "scans" / f"{frame_id}.npy", np.ones((1, 4), np.float32))
        if own_files:
            path.write_text(lines[frame_id])
    if not own_files:
        (root / "labels.jsonl").write_text("\n".join(lines.values()))
    (root / "dataset.yaml").write_text("labels: labels" if own_files else "")
    return BoxSplit(root)


def predictions(path: Path, *lines: tuple[str, float | None]) -> Path:
    """A line for each scan and time."""
    contents = [
        {"scan": scan, "boxes": [BOX | {"x_m": 1.0}]} | ({} if time_s is None else {"time_s": time_s})
        for scan, time_s in lines
    ]
    path.write_text("".join(json.dumps(one) + "\n" for one in contents))
    return path


@pytest.mark.parametrize("own_files", [True, False])
def test_the_number_of_a_message_is_no_frames_name(tmp_path: Path, own_files: bool) -> None:
    """A recording that began three scans after the dataset."""
    split = dataset(tmp_path / "own", TIMES_S, own_files)
    lines = [(f"part.mcap/{number:06d}", 1.7e9 + (3 + number) / 10) for number in range(3)]
    path = predictions(tmp_path / "found.jsonl", *lines)
    found = predictions_by_frame(path, split)
    expected = {f"{number + 3:06d}": f"part.mcap/{number:06d}" for number in range(3)}
    assert {frame_id: line.scan for frame_id, line in found.items()} == expected
    frames = read_box_predictions(path, split)
    assert [frame.frame_id for frame in frames.frames] == ["000003", "000004", "000005"], "iou and distance, too"
    assert frames.without_predictions == ("000000", "000001", "000002")


def test_messages_at_other_times_are_no_frames_whatever_their_numbers(tmp_path: Path) -> None:
    path = predictions(tmp_path / "found.jsonl", ("bag/000001", 12.0))
    for name, times_s in (("timed", TIMES_S), ("untimed", None)):
        with pytest.raises(DatasetError, match=r"no line belongs to a frame of .* such as 000000; .* `time_s`$"):
            predictions_by_frame(path, dataset(tmp_path / name, times_s))


def test_files_are_found_by_name_and_else_by_time(tmp_path: Path) -> None:
    split = dataset(tmp_path / "own", TIMES_S)
    lines = [("000001.npy", 12.0), ("a/000002.bin", None), ("000003", None), ("1700.pcd", TIMES_S["000004"])]
    found = predictions_by_frame(predictions(tmp_path / "found.jsonl", *lines), split)
    assert list(found) == ["000001", "000002", "000003", "000004"]
    split = dataset(tmp_path / "noon", {"000000": "noon"})  # type: ignore[dict-item]
    assert split.times_s == {}


def test_a_name_and_a_time_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    path = predictions(tmp_path / "found.jsonl", ("part/000000.bin", TIMES_S["000003"]))
    with pytest.raises(
        DatasetError, match=r"jsonl:1: part/000000.bin names frame 000000, .* 1700000000.300 is that of 000003; correct"
    ):
        predictions_by_frame(path, dataset(tmp_path / "own", TIMES_S))


def test_sequences_that_all_begin_at_0(tmp_path: Path) -> None:
    split = dataset(tmp_path / "own", {f"{drive}/{number:06d}": number / 10 for drive in "ab" for number in range(2)})
    lines = [("a/000001.npy", 0.1), ("b/000001.npy", 0.1)]
    assert list(predictions_by_frame(predictions(tmp_path / "a.jsonl", *lines), split)) == ["a/000001", "b/000001"]
    with pytest.raises(DatasetError, match=r"time_s 0.100 is that of a/000001 and b/000001; list the frames"):
        predictions_by_frame(predictions(tmp_path / "b.jsonl", ("b.mcap/000001", 0.1)), split)
