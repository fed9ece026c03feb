"""The gallery shows the frames that are worst, and in them what went wrong."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from asca_pillars.data.kitti import KittiSplit, read_labels, write_labels
from asca_pillars.data.kitti.kitti_labels import KittiObject
from asca_pillars.evaluation.gallery import worst_frames, write_gallery
from asca_pillars.evaluation.kitti.score_threshold import ScoreMatches, matches_at_score
from asca_pillars.evaluation.predictions import read_predictions, read_truth
from tests.scenes import GRID, write_dataset

CLASSES = ("Car", "Pedestrian", "Cyclist")
RED, MAGENTA, GREEN = (70, 70, 255), (255, 110, 255), (90, 230, 90)


def scored(objects: list[KittiObject]) -> list[KittiObject]:
    return [KittiObject(**(vars(item) | {"score": 0.9})) for item in objects]


def moved(item: KittiObject) -> KittiObject:
    """Where there is nothing: 3 m to the side of everything, still in the image."""
    return KittiObject(**(vars(item) | {"x_m": 6.0}))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Four frames of four objects: all found; all missed; all found and one false; one missed and two false."""
    root = write_dataset(tmp_path / "kitti", 4, val_frames=4)
    split = KittiSplit(root)
    for frame_id, found, false in (("000000", 4, 0), ("000001", 0, 0), ("000002", 4, 1), ("000003", 3, 2)):
        objects = scored(split.objects(frame_id))
        write_labels(tmp_path / "det" / f"{frame_id}.txt", objects[:found] + [moved(item) for item in objects[:false]])
    return root


def judge(root: Path) -> list[ScoreMatches]:
    labels = root / "training" / "label_2"
    frames = read_predictions(root.parent / "det", read_truth(labels), labels)
    return matches_at_score(frames.truth, frames.detections, CLASSES, scores=0.3)


def draw(root: Path, worst: list[ScoreMatches]) -> Path:
    folder = root.parent / "gallery"
    write_gallery(
        folder, worst, KittiSplit(root), root / "training" / "label_2", root.parent / "det", GRID.ranges, "made up"
    )
    return folder


def pixels(image: np.ndarray, color: tuple[int, int, int]) -> int:
    """Pixels of about this color beside the legend; lines of two colors may lie side by side."""
    return int((np.abs(image[:, 160:].astype(int) - color).max(axis=-1) < 50).sum())


def test_the_worst_frames_come_first_and_flawless_ones_not_at_all(root: Path) -> None:
    judged = judge(root)
    assert [frame.errors for frame in judged] == [0, 4, 1, 3]
    assert [frame.frame_id for frame in worst_frames(judged, 9)] == ["000001", "000003", "000002"]
    assert [frame.frame_id for frame in worst_frames(judged, 2)] == ["000001", "000003"]
    assert [frame.frame_id for frame in worst_frames(judged[::-1] * 2, 3)] == ["000001", "000001", "000003"]


def test_misses_and_false_detections_have_their_colors(root: Path) -> None:
    folder = draw(root, worst_frames(judge(root), 3))
    names = ["001_000001.png", "002_000003.png", "003_000002.png"]
    assert sorted(path.name for path in folder.iterdir()) == [*names, "index.md"]
    index = (folder / "index.md").read_text()
    assert index.startswith("# made up: worst frames\n")
    assert "| [000001](001_000001.png) | 4 | 0 |\n| [000003](002_000003.png) | 1 | 2 |\n" in index
    colors = [
        [pixels(np.asarray(cv2.imread(str(folder / name))), color) for color in (RED, MAGENTA, GREEN)] for name in names
    ]
    assert [[count > 100 for count in row] for row in colors] == [
        [True, False, False],
        [True, True, True],
        [False, True, True],
    ]


def test_the_image_stands_below_where_there_is_one(root: Path) -> None:
    worst = worst_frames(judge(root), 1)
    alone = np.asarray(cv2.imread(str(draw(root, worst) / "001_000001.png")))
    path = KittiSplit(root).image_path("000001")
    path.parent.mkdir()
    cv2.imwrite(str(path), np.full((375, 1242, 3), 90, np.uint8))
    both = np.asarray(cv2.imread(str(draw(root, worst) / "001_000001.png")))
    height = round(375 * alone.shape[1] / 1242)
    assert both.shape[0] == alone.shape[0] + height
    below = both[-height:]
    assert (below == 90).all(axis=-1).mean() > 0.3 and pixels(below, RED) > 100


def test_objects_without_a_box_in_3d_are_not_drawn(root: Path) -> None:
    """DontCare areas, and detections in 2D alone."""
    label, detection = root / "training" / "label_2" / "000001.txt", root.parent / "det" / "000001.txt"
    with label.open("a") as file:
        file.write("DontCare -1 -1 -10 0.00 0.00 50.00 50.00 -1 -1 -1 -1000 -1000 -1000 -10\n")
    detection.write_text("Car -1 -1 -10 100.00 100.00 200.00 200.00 -1 -1 -1 -1000 -1000 -1000 -10 0.9\n")
    worst = worst_frames(judge(root), 1)
    assert (worst[0].missed.sum(), worst[0].false_positive.sum()) == (4, 1) and len(read_labels(label)) == 5
    image = np.asarray(cv2.imread(str(draw(root, worst) / "001_000001.png")))
    assert pixels(image, MAGENTA) == 0 < pixels(image, RED)
