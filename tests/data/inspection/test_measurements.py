"""Labels in other tools' conventions are told from right ones by the points in their boxes."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from asca_pillars.config.tree import DataConfig
from asca_pillars.data.boxes.box_records import json_line, read_frames, records_from
from asca_pillars.data.inspection.findings import findings
from asca_pillars.data.inspection.inspect_dataset import inspect_dataset
from asca_pillars.data.inspection.measurements import CONVENTIONS, better_convention, convention_fits, count_points
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.data.open_split import open_split
from asca_pillars.geometry.boxes import points_in_boxes
from tests.data.boxes.box_scenes import write_box_dataset
from tests.helpers.in_process import invoke
from tests.helpers.scenes import SPEC, make_scene

MIRROR, QUARTER_TURN = np.array([1, 1, 1, 1, 1, 1, -1]), np.array([0, 0, 0, 0, 0, 0, np.pi / 2])
WRONG: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "turned by 90 degrees": lambda boxes: boxes + QUARTER_TURN,
    "mirrored": lambda boxes: boxes * MIRROR,
    "mirrored and turned by 90 degrees": lambda boxes: boxes * MIRROR - QUARTER_TURN,
    "raised by half a height": lambda boxes: boxes - boxes[:, [5]] * [0, 0, 0.5, 0, 0, 0, 0],
    "lowered by half a height": lambda boxes: boxes + boxes[:, [5]] * [0, 0, 0.5, 0, 0, 0, 0],
}


def swapped(boxes: np.ndarray) -> np.ndarray:
    return boxes[:, [0, 1, 2, 4, 3, 5, 6]]


def name_of(frames: list[tuple[np.ndarray, np.ndarray]], wrong: Callable[[np.ndarray], np.ndarray]) -> str | None:
    """The convention that fits better, of points and boxes of several frames with the boxes made wrong."""
    counts = [count_points(points, wrong(boxes.astype(np.float64)).astype(np.float32)) for points, boxes in frames]
    better = better_convention(convention_fits(np.concatenate(counts, axis=1)))
    return None if better is None else better[0].name


@pytest.fixture(scope="module")
def scenes() -> list[tuple[np.ndarray, np.ndarray]]:
    return [make_scene(seed)[:2] for seed in range(12)]


@pytest.fixture(scope="module")
def real() -> list[tuple[np.ndarray, np.ndarray]]:
    root = os.environ.get("ASCA_KITTI_MINI")
    if root is None:
        pytest.skip("ASCA_KITTI_MINI is not set: no real scans here")
    split = KittiSplit(root)
    return [(split.points(one, camera_view=True), split.labeled_boxes(one).boxes) for one in split.frame_ids]


@pytest.mark.parametrize("frames", ["scenes", "real"])
def test_right_labels_pass_and_wrong_ones_are_told(frames: str, request: pytest.FixtureRequest) -> None:
    given = request.getfixturevalue(frames)
    assert name_of(given, lambda boxes: boxes) is None
    assert {name: name_of(given, wrong) for name, wrong in WRONG.items()} == {name: name for name in WRONG}
    assert name_of(given, swapped) == "turned by 90 degrees"


def test_counts_are_those_of_changed_boxes_and_some_say_nothing(scenes: list[tuple[np.ndarray, np.ndarray]]) -> None:
    points, boxes = scenes[0]
    counts = count_points(points, boxes)
    changes = {"as labelled": boxes} | {name: wrong(boxes.astype(np.float64)) for name, wrong in WRONG.items()}
    lowered, raised = "lowered by half a height", "raised by half a height"
    changes[lowered], changes[raised] = changes[raised], changes[lowered]  # each but a shift undoes itself
    for convention, row in zip(CONVENTIONS, counts, strict=True):
        changed = changes[convention.name].astype(np.float32)
        np.testing.assert_array_equal(row, points_in_boxes(points, changed).sum(axis=0), err_msg=convention.name)
    assert count_points(points, boxes[:0]).shape == (6, 0)
    assert better_convention(convention_fits(np.zeros((6, 0), np.int64))) is None
    # Square boxes and objects without points fit every yaw alike.
    rng = np.random.default_rng(0)
    boxes = np.zeros((20, 8, 7), np.float32)
    boxes[..., :2], boxes[..., 3:6] = rng.uniform(5, 40, (20, 8, 2)), (0.7, 0.7, 1.8)
    boxes[..., 6] = rng.uniform(-3, 3, (20, 8))
    near = boxes[:, :, None, :3] + rng.uniform(-0.3, 0.3, (20, 8, 20, 3)) * [1, 1, 3]
    frames = list(zip(near.reshape(20, -1, 3).astype(np.float32), boxes, strict=True))
    assert name_of(frames, lambda boxes: boxes) is None
    assert name_of([(points[:0], own) for points, own in frames], lambda boxes: boxes) is None


def rewritten(root: Path, change: Callable[[np.ndarray], np.ndarray]) -> Path:
    write_box_dataset(root, 12, names=("Car", "Car", "Pedestrian", "Cyclist"))
    frames = [(scan, records) for scan, records, *_ in read_frames(root / "labels.jsonl")]
    lines = [json_line(scan, records_from(change(records.boxes), records.types)) for scan, records in frames]
    (root / "labels.jsonl").write_text("".join(lines))
    return root


def test_inspect_names_the_convention_and_shows_both_counts(tmp_path: Path) -> None:
    root = rewritten(tmp_path / "data", WRONG["turned by 90 degrees"])
    output = invoke("inspect", root, "-c", "asca_small_sim", "--split", "training")
    assert "warning: the points fit the boxes better turned by 90 degrees:" in output
    assert "Conventions:" in output and "as labelled" in output


def whole(boxes: np.ndarray) -> np.ndarray:
    """Small angles in degrees, of streets along x."""
    return np.column_stack([boxes[:, :6], np.round(boxes[:, 6] * 2)])


@pytest.mark.parametrize("change", [whole, lambda boxes: boxes])
def test_whole_yaws_are_doubted(change: Callable[[np.ndarray], np.ndarray], tmp_path: Path) -> None:
    split = open_split(rewritten(tmp_path / "data", change))
    inspection = inspect_dataset(split, SPEC, DataConfig(workers=0))
    texts = [item.text for item in findings(inspection, SPEC, 1) if "whole numbers" in item.text]
    assert ["in radians" in text and "pi / 180" in text for text in texts] == [True] * (change is whole)
