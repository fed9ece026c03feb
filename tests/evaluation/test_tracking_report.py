"""Tracks of simulated sequences, scored: what counts, and how lines find their frames."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from asca_deploy.evaluate import evaluate
from asca_pillars.base.errors import ConfigError, DatasetError, OutputError
from asca_pillars.cli.main import app
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.evaluation.tracking_report import (
    TrackingReport,
    tracking_json,
    tracking_notes,
    tracking_report,
)
from asca_pillars.sim.sequence_files import simulate_sequences
from asca_pillars.sim.simulation import load_simulation_config
from tests.helpers.earlier_evaluation import earlier_predictions

CLASSES = ("Car", "Pedestrian", "Cyclist")


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = load_simulation_config("vlp_16", "around")
    return simulate_sequences(tmp_path_factory.mktemp("drives"), 2, 3, 3, 1, config)


def labels(drives: Path) -> list[dict[str, Any]]:
    """The labels of every frame as predictions are written."""
    lines = []
    for frame_id in BoxSplit(drives).frame_ids:
        content = json.loads((drives / "labels" / f"{frame_id}.json").read_text())
        boxes = [box | {"score": 0.9} for box in content["boxes"] if box["class"] in CLASSES]
        lines.append({"scan": f"{frame_id}.bin", "time_s": content["time_s"], "boxes": boxes})
    return lines


def score(drives: Path, folder: Path, lines: list[dict[str, Any]]) -> TrackingReport:
    folder.mkdir(exist_ok=True)
    (folder / "detections.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return tracking_report(BoxSplit(drives), folder, "labels", {})


def test_labels_as_tracks_are_perfect_by_name_and_by_time(drives: Path, tmp_path: Path) -> None:
    by_name = labels(drives)
    by_time = [line | {"scan": f"drive.mcap/{index:06d}"} for index, line in enumerate(by_name)]
    for lines in (by_name, by_time):
        report = score(drives, tmp_path / "out", lines)
        json.dumps(tracking_json(report), allow_nan=False)
        assert report.frames == report.frames_found == 6
        assert [one.name for one in report.scores if one.clear.labels]
        for one in report.scores:
            if one.clear.labels:
                assert one.hota == pytest.approx((1, 1, 1, 1)) and one.clear.mota == 1.0
                assert one.clear.identity_switches == one.clear.fragmentations == 0


def test_new_identities_in_every_frame_are_switches(drives: Path, tmp_path: Path) -> None:
    lines = labels(drives)
    for index, line in enumerate(lines):
        line["boxes"] = [box | {"track_id": box["track_id"] + 10_000 * index} for box in line["boxes"]]
    report = score(drives, tmp_path, lines)
    car = next(one for one in report.scores if one.name == "Car")
    assert car.hota.det_a == pytest.approx(1) and car.hota.ass_a < 0.5
    assert car.clear.identity_switches > car.clear.labels / 2


@pytest.mark.parametrize(("kept", "missing"), [(slice(3), slice(3, 6)), (slice(3, 6), slice(3))])
def test_labels_of_frames_without_a_line_are_misses(drives: Path, tmp_path: Path, kept: slice, missing: slice) -> None:
    lines = labels(drives)
    report = score(drives, tmp_path, lines[kept])
    assert (report.frames, report.frames_found) == (6, 3)
    unseen = [box for line in lines[missing] for box in line["boxes"] if box["points"] >= 5 and box["occluded"] < 3]
    expected = Counter(box["class"] for box in unseen)
    assert len(expected) > 1
    assert {one.name: one.clear.misses for one in report.scores} == {name: expected[name] for name in CLASSES}


def test_what_the_detector_cannot_see_is_not_counted(drives: Path, tmp_path: Path) -> None:
    everything = sum(one.clear.labels for one in score(drives, tmp_path, labels(drives)).scores)
    stated = {"classes": CLASSES, "ranges_m": [[0, 69], [-30, 30]]}
    ahead = score(drives, tmp_path, [line | {"detector": stated} for line in labels(drives)])
    assert 0 < ahead.counted < everything and ahead.outside > 0
    assert all(one.clear.false_boxes == 0 for one in ahead.scores), "boxes of labels that do not count go with them"
    # Results of earlier versions state it in recording.json alone.
    (tmp_path / "recording.json").write_text(json.dumps(stated))
    assert score(drives, tmp_path, labels(drives)).scores == ahead.scores
    # What the lines state comes first: the file may be of an earlier run into the same folder.
    around = score(drives, tmp_path, [line | {"detector": stated | {"ranges_m": None}} for line in labels(drives)])
    assert (around.counted, around.outside) == (everything, 0)


def test_a_note_says_which_labels_are_counted_and_why(drives: Path, tmp_path: Path) -> None:
    unknown = score(drives, tmp_path, labels(drives))
    assert unknown.scope is None and unknown.hidden > 0
    total = unknown.counted + unknown.hidden
    note = tracking_notes(unknown)[1]
    assert note.startswith(f"{unknown.counted} of {total} ") and "do not state the detector's ranges" in note
    stated = {"detector": {"classes": CLASSES, "ranges_m": [[0, 69], [-30, 30]]}}
    known = score(drives, tmp_path, [line | stated for line in labels(drives)])
    assert known.counted + known.outside + known.hidden == total
    note = tracking_notes(known)[1]
    assert note.startswith(f"{known.counted} of {total} ") and f"{known.outside} lie outside" in note
    assert "x 0 to 69 m and y -30 to 30 m" in note
    content = tracking_json(known)
    assert (content["labels_counted"], content["labels_outside_ranges"]) == (known.counted, known.outside)
    # Lines of two detectors: of neither it is known what it could have found in the other's frames.
    half = [line | (stated if index < 3 else {}) for index, line in enumerate(labels(drives))]
    assert score(drives, tmp_path, half).scope is None


def test_a_class_that_is_never_found_is_scored_or_named(drives: Path, tmp_path: Path) -> None:
    lines = labels(drives)
    for line in lines:
        line["boxes"] = [box for box in line["boxes"] if box["class"] != "Pedestrian"]
    report = score(drives, tmp_path, lines)
    assert report.not_scored["Pedestrian"] > 0 and "Pedestrian" in tracking_notes(report)[-1]
    (tmp_path / "recording.json").write_text(json.dumps({"classes": CLASSES, "ranges_m": None}))
    report = score(drives, tmp_path, lines)
    missed = next(one for one in report.scores if one.name == "Pedestrian")
    assert missed.clear.misses == missed.clear.labels > 0 and "Pedestrian" not in report.not_scored
    for damaged in (
        *("{", "[" * 9000, "[1]", '{"classes": "Car"}', '{"classes": [1]}', '{"ranges_m": {"x": [0, 69]}}'),
        *(f'{{"ranges_m": [[{x}], [-30, 30]]}}' for x in ("0, null", "0", "0, 1e308")),
        '{"ranges_m": [[0, 69]]}',
    ):
        (tmp_path / "recording.json").write_text(damaged)
        with pytest.raises(DatasetError, match=r"recording\.json: cannot be read"):
            score(drives, tmp_path, lines)


BOX = {"class": "Car", "y_m": 0, "z_m": 0, "length_m": 4, "width_m": 2, "height_m": 1.5, "yaw_rad": 0, "score": 0.9}


def street(folder: Path, axes: str, records: list[dict[str, Any]]) -> Path:
    """Labels of one object in frames 0, 1, 2 ..., and an empty scan for each."""
    (folder / "scans").mkdir(parents=True)
    for number in range(len(records)):
        np.save(folder / "scans" / f"{number}.npy", np.ones((1, 4), np.float32))
    settings = {"scans": "scans", "labels": "labels.jsonl", "axes": axes, "sensor_height": 1.73}
    (folder / "dataset.yaml").write_text(json.dumps(settings))
    lines = [{"scan": f"{number}.npy", "boxes": [record]} for number, record in enumerate(records)]
    (folder / "labels.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


def test_frames_without_times_are_in_natural_order(tmp_path: Path) -> None:
    """One change of the identity, after the sixth of twelve frames: 10 and 11 do not come before 2."""
    own = [BOX | {"x_m": 10 + number, "track_id": 1} for number in range(12)]
    root = street(tmp_path / "own", "x-forward", own)
    ids = [{"track_id": 1 + (number > 5)} for number in range(12)]
    found = [{"scan": f"{number}.npy", "boxes": [own[number] | ids[number]]} for number in range(12)]
    (car,) = score(root, tmp_path / "out", found).scores
    assert car.clear.identity_switches == 1 and car.clear.mota == pytest.approx(11 / 12)


@pytest.mark.parametrize(
    "change", [{"occluded": "partly"}, {"points": None}, {"track_id": "9" * 20}, {"track_id": "red van"}]
)
def test_labels_of_others_may_hold_anything_beside_their_boxes(tmp_path: Path, change: dict[str, Any]) -> None:
    own = [BOX | {"x_m": 9, "y_m": 0, "track_id": "7"}]
    root = street(tmp_path / "own", "x-forward", own)
    label = root / "labels" / "0.json"
    label.parent.mkdir()
    label.write_text(json.dumps({"boxes": [own[0] | change]}))
    settings = root / "dataset.yaml"
    settings.write_text(settings.read_text().replace("labels.jsonl", "labels"))
    (car,) = score(root, tmp_path / "out", [{"scan": "0.npy", "boxes": own}]).scores
    assert car.hota == pytest.approx((1, 1, 1, 1)) and car.clear.labels == 1


def test_ranges_are_those_of_the_model_whatever_the_axes(tmp_path: Path) -> None:
    """y-forward: a car 50 m ahead lies at y = 50."""
    own = [BOX | {"x_m": 0, "y_m": 50, "track_id": 1}]
    root = street(tmp_path / "own", "y-forward", own)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "recording.json").write_text(json.dumps({"classes": ["Car"], "ranges_m": [[0, 69], [-30, 30]]}))
    (car,) = score(root, tmp_path / "out", [{"scan": "0.npy", "boxes": own}]).scores
    assert car.clear.labels == 1 and car.clear.mota == 1


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ([1], 'jsonl:1: no "scan"'),
        ({"scan": "0.npy"}, 'jsonl:1: no list "boxes"'),
        ({"scan": "0.npy", "boxes": [{"x_m": 1}]}, "jsonl:1, box 1: no `class`"),
        ({"scan": "0.npy", "boxes": [BOX]}, "jsonl:1, box 1: no `x_m`"),
    ],
)
def test_malformed_predictions_are_one_line(tmp_path: Path, line: Any, message: str) -> None:
    root = street(tmp_path / "own", "x-forward", [BOX | {"x_m": 10, "track_id": 1}])
    with pytest.raises(DatasetError, match=message):
        score(root, tmp_path / "out", [line])


def test_the_command_prints_and_writes(drives: Path, tmp_path: Path) -> None:
    score(drives, tmp_path / "found", labels(drives))
    earlier_predictions(tmp_path / "out")
    options = ["--protocol", "tracking", "--split", "training", "--data", drives, "--predictions", tmp_path / "found"]
    result = CliRunner().invoke(app, ["eval", *map(str, options), "-o", str(tmp_path / "out")], catch_exceptions=False)
    assert result.exit_code == 0 and "HOTA" in result.output and "switches" in result.output
    tables = [line for line in result.output.splitlines() if line.startswith(("┃", "│"))]
    assert tables and max(map(len, tables)) <= 80 and not any("…" in line for line in tables)
    assert not (tmp_path / "out" / "predictions").exists()
    written = json.loads((tmp_path / "out" / "tracking.json").read_text())
    assert written["classes"]["Car"]["hota"] == pytest.approx(1) and written["frames"] == 6
    assert "| Car |" in (tmp_path / "out" / "tracking.md").read_text()
    assert "environment" in written


def test_what_cannot_be_scored_or_written_is_refused(drives: Path, tmp_path: Path) -> None:
    without = labels(drives)
    for line in without:
        line["boxes"] = [{key: value for key, value in box.items() if key != "track_id"} for box in line["boxes"]]
    with pytest.raises(DatasetError, match="without `track_id`"):
        score(drives, tmp_path, without)
    twice = labels(drives)
    twice[0]["boxes"] = twice[0]["boxes"][:1] * 2
    with pytest.raises(DatasetError, match="the same `track_id`"):
        score(drives, tmp_path, twice)
    with pytest.raises(DatasetError, match="no line belongs to a frame"):
        score(drives, tmp_path, [{"scan": "elsewhere.bin", "time_s": 1e9, "boxes": []}])
    with pytest.raises(ConfigError, match="give --data"):
        CliRunner().invoke(app, ["eval", "--protocol", "tracking"], catch_exceptions=False)
    lines = labels(drives)
    with pytest.raises(DatasetError, match=r"jsonl:7: frame .* has predictions in .*jsonl:1; merge them"):
        score(drives, tmp_path, [*lines, lines[0]])
    with pytest.raises(OutputError, match="is a folder"):
        options: dict[str, Any] = {"split": "training", "protocol": "tracking", "json": tmp_path}
        evaluate(data=drives, out=tmp_path / "out", predictions=tmp_path / "none", **options)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fast"], "fast: --protocol tracking runs no model"),
        (["--around"], "--around runs a model"),
        (["--labels", "x"], "--labels x belongs to --protocol kitti and waymo"),
        (["--gallery", "3"], "--gallery 3 belongs to --protocol kitti"),
        (["--score", "0.5"], "--score 0.5: --protocol tracking goes over all tracks"),
    ],
)
def test_options_of_other_protocols_are_refused(tmp_path: Path, arguments: list[str], message: str) -> None:
    where = ["--protocol", "tracking", "--data", str(tmp_path), "--predictions", str(tmp_path)]
    with pytest.raises(ConfigError, match=message):
        CliRunner().invoke(app, ["eval", *arguments, *where], catch_exceptions=False)
