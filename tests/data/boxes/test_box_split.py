"""The layout of boxes: what frames there are, what is in them, and that everything that trains reads it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from asca_pillars.base.errors import ConfigError, DatasetError
from asca_pillars.base.schema import to_dict
from asca_pillars.cli.train import prepare
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import Config, DataConfig, InsertConfig, pillar_spec
from asca_pillars.data.augment import open_frames
from asca_pillars.data.boxes.box_records import json_line, read_frames, records_from
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.frames import read_frame
from asca_pillars.data.insertion.insert_objects import insert_objects, prepare_inserter
from asca_pillars.data.inspection.findings import Finding, findings
from asca_pillars.data.inspection.inspect_dataset import inspect_dataset
from asca_pillars.data.open_split import open_split
from asca_pillars.detection.anchors import ClassSpec
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_reader import read_scan, write_scan
from tests.data.boxes.box_scenes import write_box_dataset
from tests.helpers.scenes import SPEC, make_scene

CLASSES = (SPEC.classes[0], ClassSpec("Forklift", 0.8, 0.6, 1.73, -0.87, 0.35, 0.2))
CONFIG = Config(model=PillarModel(spec=replace(SPEC, classes=CLASSES)), data=DataConfig(workers=0))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_box_dataset(tmp_path / "own", 4)


def test_a_frame_holds_its_points_and_boxes_all_around(root: Path) -> None:
    split = open_split(root, "train")
    assert isinstance(split, BoxSplit) and split.frame_ids == ("000000", "000001", "000002")
    points, boxes, _ = make_scene(1, ("Car", "Pedestrian"))
    frame = read_frame(split, "000001", ("Forklift",))  # camera_view is on: without a camera there is nothing to cut
    assert np.array_equal(frame.points, points)
    assert frame.labels.tolist() == [0] and np.abs(frame.boxes - boxes[1:]).max() < 1e-4
    assert split.label_types("000001") == ["Car", "Forklift"]
    # Straight behind: rounded to float32, half a turn is more than half a turn.
    split, behind = BoxSplit(root), np.array([[-5, 0, 0, 0.1]], np.float32)
    assert split.in_labeled_view("000000", behind).all()
    write_scan(split.scan_path("000000"), behind)
    assert len(split.points("000000", camera_view=True)) == 1


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
    for name in ("free_space.find_free_space", "gt_database._build"):
        monkeypatch.setattr(f"asca_pillars.data.insertion.{name}", lambda *_: pytest.fail("again"))
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


# --- which scans are frames, and what is said of labels without one


def frame_ids(root: Path, settings: str | None = None, name: str = "training") -> tuple[str, ...]:
    if settings is not None:
        (root / "dataset.yaml").write_text(settings)
    return BoxSplit(root, name).frame_ids


def test_a_file_for_each_frame_gives_the_same(root: Path) -> None:
    expected = [BoxSplit(root).labeled_boxes(frame_id).boxes for frame_id in frame_ids(root)]
    (root / "labels").mkdir()
    for number, line in enumerate((root / "labels.jsonl").read_text().splitlines()):
        (root / "labels" / f"{number:06d}.json").write_text(line)
    (root / "labels.jsonl").unlink()
    assert frame_ids(root, "labels: labels\n") == tuple(f"{number:06d}" for number in range(4))
    np.testing.assert_array_equal([BoxSplit(root).labeled_boxes(name).boxes for name in frame_ids(root)], expected)


def test_with_a_csv_scans_without_a_row_are_frames_without_objects(root: Path) -> None:
    (root / "labels.csv").write_text("scan,class,x,y,z,length,width,height,yaw\n000002.bin,Car,10,0,-1,4,2,1.5,0\n")
    names = frame_ids(root, "labels: labels.csv\n", "train")
    assert [len(BoxSplit(root).labeled_boxes(frame_id).boxes) for frame_id in names] == [0, 0, 1]
    with pytest.raises(DatasetError, match=r"000000\.bin: no such folder"):
        frame_ids(root, "labels: labels.csv\nscans: scans/000000.bin\n")
    np.save(root / "scans" / "000001.npy", np.zeros((5, 4), np.float32))
    with pytest.raises(DatasetError, match=r"000001\.bin and .*000001\.npy: both would be frame 000001; rename one"):
        frame_ids(root, "labels: labels.csv\n")


def test_scans_may_lie_anywhere_and_in_folders(root: Path, tmp_path: Path) -> None:
    labels = root / "labels.jsonl"
    text = labels.read_text()
    labels.write_text(text.replace('"scan": "', f'"scan": "{root}/scans/'))
    assert len(frame_ids(root)) == 4
    (tmp_path / "drive").mkdir()
    (root / "scans").rename(tmp_path / "drive" / "a")
    labels.write_text(text.replace('"scan": "', '"scan": "a/'))
    assert frame_ids(root, f"scans: {tmp_path / 'drive'}\n")[0] == "a/000000"
    assert len(BoxSplit(root).points("a/000000")) > 1000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"scan": "9.bin", "boxes": []}', r"labels\.jsonl:1: no scan 9\.bin below .*correct the name"),
        ('{"scan": "../000000.bin", "boxes": []}', r"labels\.jsonl:1: no scan"),
        (f'{{"scan": "{"a/" * 200_000}x.bin", "boxes": []}}', r"labels\.jsonl:1: no scan"),
        ('{"scan": "000000.bin", "boxes": []}\n' * 2, r"labels\.jsonl:2: 000000\.bin has labels in .*jsonl:1 already"),
        ("", r"labels\.jsonl: contains no frame"),
        ('{"scan": "000000.bin", "boxes": []}', r"000001: listed in ImageSets/train\.txt, but .* has no such frame"),
    ],
    ids=range(6),
)
def test_wrong_labels_are_named(root: Path, text: str, message: str) -> None:
    (root / "labels.jsonl").write_text(text)
    with pytest.raises(DatasetError, match=message):
        frame_ids(root, name="train")


def test_a_wrong_file_of_labels_is_named(root: Path) -> None:
    (root / "labels").mkdir()
    for name, text, message in (
        ("9.json", '{"boxes": []}', r"9\.json: belongs to one scan .* there is none"),
        ("000000.txt", "10.0 1.0 -1.0 4.1 1.7 1.5 1.2 Car\n", r"000000\.txt is text: .*--from openpcdet"),
    ):
        (root / "labels" / name).write_text(text)
        with pytest.raises(DatasetError, match=message):
            frame_ids(root, "labels: labels\n")
        (root / "labels" / name).unlink()
