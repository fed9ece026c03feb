"""The layout of boxes: what frames there are, what is in them, and that everything that trains reads it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.schema import to_dict
from asca_pillars.cli.prepare import prepare
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import Config, DataConfig, InsertConfig, pillar_spec
from asca_pillars.data.boxes.box_records import json_line, read_frames, records_from
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.frames import read_frame
from asca_pillars.data.insertion.insert_objects import insert_objects, prepare_inserter
from asca_pillars.data.inspection.findings import Finding, findings
from asca_pillars.data.inspection.inspect_dataset import inspect_dataset
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.data.open_split import open_split
from asca_pillars.data.training_frames import open_frames
from asca_pillars.detection.anchors import ClassSpec
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_reader import read_scan, write_scan
from tests.helpers.scenes import SPEC, make_scene, write_dataset

CLASSES = (SPEC.classes[0], ClassSpec("Forklift", 0.8, 0.6, 1.73, -0.87, 0.35, 0.2))
CONFIG = Config(model=PillarModel(spec=replace(SPEC, classes=CLASSES)), data=DataConfig(workers=0))


def test_the_layout_tells_the_reader(root: Path, tmp_path: Path) -> None:
    assert isinstance(open_split(root), BoxSplit)
    assert isinstance(open_split(write_dataset(tmp_path / "kitti", 1)), KittiSplit)


def test_a_frame_holds_its_points_and_boxes(root: Path) -> None:
    split = open_split(root, "train")
    assert split.frame_ids == ("000000", "000001", "000002")
    points, boxes, _ = make_scene(1, ("Car", "Pedestrian"))
    frame = read_frame(split, "000001", ("Forklift",))  # camera_view is on: without a camera there is nothing to cut
    assert np.array_equal(frame.points, points)
    assert frame.labels.tolist() == [0] and np.abs(frame.boxes - boxes[1:]).max() < 1e-4
    assert split.label_types("000001") == ["Car", "Forklift"]


def test_a_scale_left_open_is_part_of_what_points_depend_on(root: Path) -> None:
    (root / "dataset.yaml").write_text("reflectance_scale: auto\n")
    before = BoxSplit(root).points_state("000000")
    assert BoxSplit(root).points_state("000000") == before
    for path in sorted((root / "scans").iterdir())[1:]:
        points = read_scan(path).points
        points[:, 3] = np.linspace(0, 255, len(points)).round()
        write_scan(path, points)
    after = BoxSplit(root)
    assert after.points("000000")[:, 3].max() < 0.1 and after.points_state("000000") != before


def test_points_are_turned_and_scaled_as_the_dataset_says(root: Path) -> None:
    plain = read_scan(root / "scans" / "000000.bin").points
    columns = np.column_stack([-plain[:, 1], plain[:, 0], plain[:, 2], plain[:, 3] * 100, np.zeros(len(plain))])
    columns.astype("<f4").tofile(root / "scans" / "000000.bin")
    boxes = BoxSplit(root).labeled_boxes("000000").boxes
    level = Mounting(axes="y-forward").level
    line = json_line("000000.bin", records_from(level.inverse.boxes(boxes), ["Car", "Forklift"]))
    (root / "labels.jsonl").write_text(line + "".join((root / "labels.jsonl").read_text().splitlines(True)[1:]))
    (root / "dataset.yaml").write_text("{axes: y-forward, columns: 5, reflectance_scale: 100}\n")
    split = BoxSplit(root)
    np.testing.assert_allclose(split.points("000000"), plain, atol=1e-6)
    np.testing.assert_allclose(split.stored_points("000000"), plain, atol=1e-6)
    np.testing.assert_allclose(split.labeled_boxes("000000").boxes, boxes, atol=1e-3)


def test_the_mounting_has_the_words_of_the_options(root: Path) -> None:
    pose = np.array([[0, 1, 0, 0.5], [-1, 0, 0, 0], [0, 0, 1, 1.73], [0, 0, 0, 1.0]])
    plain = BoxSplit(root).points("000000")
    (root / "pose.txt").write_text("\n".join(" ".join(map(str, row)) for row in pose))
    (root / "dataset.yaml").write_text("{pose: pose.txt, sensor_height: auto}\n")
    split = BoxSplit(root)
    expected = plain[:, :3] @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(split.points("000000")[:, :3], expected, atol=1e-5)
    assert split.mounting.sensor_height_m == pytest.approx(0, abs=0.1)  # the scenes' sensor sits at 1.73 m
    (root / "dataset.yaml").write_text("sensor_height: 1.5\n")
    stated = BoxSplit(root)
    assert stated.mounting == Mounting(1.5) and np.array_equal(stated.points("000000"), plain)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("scan: x", "scans"),
        ("columns: 2", "columns 2"),
        ("reflectance_scale: 0", "must be positive"),
        ("axes: up", "axes up: give x-forward"),
        ("sensor_height: 40", "sensor height 40"),
        ("{axes: y-forward, pose: p.txt}", "give one of them"),
    ],
)
def test_wrong_settings_are_named(root: Path, text: str, message: str) -> None:
    (root / "dataset.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        BoxSplit(root).frame_ids  # noqa: B018


def test_inspection_and_insertion_read_it(root: Path) -> None:
    split, spec = open_split(root, "train"), pillar_spec(CONFIG)
    inspection = inspect_dataset(split, spec, CONFIG.data)
    assert inspection.types == {"Car": 3, "Forklift": 3} and [facts.boxes for facts in inspection.classes] == [3, 3]
    assert not [finding for finding in findings(inspection, spec, 1) if finding.level == "error"]
    inserter = prepare_inserter(split, spec, CONFIG.data, InsertConfig("gt_aug", objects=4))
    frame = read_frame(split, "000000", spec.class_names)
    assert len(insert_objects(frame, inserter, np.random.default_rng(0)).boxes) > len(frame.boxes)
    assert inserter.free_space("000000").free.any()


def test_prepare_makes_the_maps_that_training_reads(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a camera nothing is cut to its view, whatever `data.camera_view` is by default."""
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(to_dict(CONFIG)))
    prepare(tmp_path / "own.yaml", data=root, workers=1)
    monkeypatch.setattr("asca_pillars.data.insertion.free_space.find_free_space", lambda _: pytest.fail("again"))
    monkeypatch.setattr("asca_pillars.data.insertion.gt_database._build", lambda *_: pytest.fail("built again"))
    insert = replace(CONFIG.augment, insert=InsertConfig("rs_aug", objects=4))
    inserter = open_frames(root, replace(CONFIG, augment=insert), training=True).inserter
    assert inserter is not None and all(inserter.free_space(name).free.any() for name in inserter.split.frame_ids)


def test_inspection_notices_axes_that_lie_otherwise(root: Path) -> None:
    """The scenes are ahead of the sensor only: with x to the right they stand to the left."""
    spec = pillar_spec(CONFIG)

    def found() -> list[Finding]:
        return findings(inspect_dataset(open_split(root), spec, CONFIG.data), spec, 1)

    right, back = found(), Mounting(axes="y-forward").level.inverse
    for path in (root / "scans").iterdir():
        write_scan(path, back.points(read_scan(path).points))
    frames = list(read_frames(root / "labels.jsonl"))
    turned = [json_line(scan, records_from(back.boxes(own.boxes), own.types)) for scan, own, *_ in frames]
    (root / "labels.jsonl").write_text("".join(turned))
    (text,) = [finding.text for finding in found() if finding.about == "axes"]
    assert "state the axes, `axes: y,-x,z` in dataset.yaml" in text
    (root / "dataset.yaml").write_text("axes: y,-x,z\n")
    assert [finding.about for finding in found()] == [finding.about for finding in right]


def test_labels_all_around_leave_nothing_out(root: Path) -> None:
    """Straight behind: rounded to float32, half a turn is more than half a turn."""
    split, behind = BoxSplit(root), np.array([[-5, 0, 0, 0.1]], np.float32)
    assert split.in_labeled_view("000000", behind).all()
    write_scan(split.scan_path("000000"), behind)
    assert len(split.points("000000", camera_view=True)) == 1
