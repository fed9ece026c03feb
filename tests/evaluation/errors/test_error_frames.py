"""What is read of KITTI's files and of boxes without a camera."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.kitti import KittiObject, KittiSplit, read_labels, write_labels
from asca_pillars.evaluation.boxes.box_pairs import EvaluatedFrame
from asca_pillars.evaluation.errors.error_frames import UNKNOWN_OCCLUSION, BoxErrorFrames, KittiErrorFrames
from tests.data.boxes.box_scenes import write_box_dataset
from tests.helpers.scenes import write_dataset

NAMES = ("Car", "Pedestrian", "Cyclist")


@pytest.fixture
def frames(tmp_path: Path) -> KittiErrorFrames:
    split = KittiSplit(write_dataset(tmp_path / "kitti", 1))
    labels = split.folder / "label_2"
    found = [replace(item, score=0.9) for item in read_labels(labels / "000000.txt")]
    write_labels(tmp_path / "found" / "000000.txt", found)
    return KittiErrorFrames(split, labels, tmp_path / "found", NAMES, ("000000",))


def rewritten(folder: Path, **changes) -> list[KittiObject]:
    """Change the first object of a file."""
    first, *others = read_labels(folder / "000000.txt")
    write_labels(folder / "000000.txt", [replace(first, **changes), *others])
    return [first, *others]


def test_objects_count_within_the_limits_of_moderate(frames: KittiErrorFrames) -> None:
    made = frames.read("000000")
    assert made.types == ("Car", "Car", "Pedestrian", "Cyclist") and made.counted.all() and not made.ignored.any()
    assert (made.object_points > 30).all()
    np.testing.assert_allclose(made.detections, made.objects, atol=1e-3)
    for changes in ({"occluded": 2}, {"truncated": 0.5}, {"bbox": (0.0, 100.0, 50.0, 120.0)}, {"type": "Van"}):
        before = rewritten(frames.labels, **changes)
        assert frames.read("000000").counted.tolist() == [False, True, True, True]
        write_labels(frames.labels / "000000.txt", before)
    rewritten(frames.labels, type="car", z_m=60.0, occluded=1)
    made = frames.read("000000")
    assert made.types[0] == "Car" and made.occluded.tolist() == [1, -1, -1, -1]
    assert made.object_points[0] == 0 and not made.counted[0], "nobody can find what holds no point"


def test_detections_in_dont_care_areas_and_low_ones_are_ignored(frames: KittiErrorFrames) -> None:
    car, *_ = read_labels(frames.labels / "000000.txt")
    area = KittiObject("DontCare", -1, -1, -10, car.bbox, -1, -1, -1, -1000, -1000, -1000, -10)
    write_labels(frames.labels / "000000.txt", [*read_labels(frames.labels / "000000.txt"), area])
    made = frames.read("000000")
    assert made.ignored[0] and len(made.objects) == 4
    rewritten(frames.predictions, bbox=(0.0, 100.0, 50.0, 120.0))
    assert frames.read("000000").ignored[0]


def test_boxes_are_seen_from_the_sensor(tmp_path: Path) -> None:
    root = write_box_dataset(tmp_path / "own", 1)
    (root / "dataset.yaml").write_text("sensor_position: [2.0, 1.0, 0.5]\n")
    split = BoxSplit(root)
    boxes, types = split.labeled_boxes("000000")
    frame = EvaluatedFrame("000000", boxes, types, np.ones(2, bool), boxes[:1], types[:1], np.array([0.8]))
    reader = BoxErrorFrames(split, (frame,))
    assert reader.frame_ids == ("000000",)
    made = reader.read("000000")
    np.testing.assert_allclose(made.objects[:, :3], boxes[:, :3] - [2.0, 1.0, 0.5], atol=1e-5)
    np.testing.assert_allclose(made.detections[0], made.objects[0])
    points = split.points("000000", camera_view=False)[:, :3]
    np.testing.assert_allclose(made.points[:, :3], points - np.array([2.0, 1.0, 0.5]), atol=1e-5)
    assert made.counted.all() and (made.occluded == UNKNOWN_OCCLUSION).all() and made.scores.tolist() == [0.8]
