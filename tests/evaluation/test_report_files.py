"""The gallery shows the frames that are worst, and in them what went wrong."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from asca_pillars.data.kitti import KittiSplit, read_labels, write_labels
from asca_pillars.data.kitti.kitti_labels import KittiObject
from asca_pillars.evaluation.kitti.score_threshold import ScoreMatches, matches_at_score
from asca_pillars.evaluation.predictions import read_predictions, read_truth
from asca_pillars.evaluation.report_files import EvaluatedDetector, most_different_frames, worst_frames, write_gallery
from tests.helpers.gallery_cards import cards, sources, title
from tests.helpers.scenes import GRID, write_dataset

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


def match_detections(root: Path, predictions: str = "det") -> list[ScoreMatches]:
    labels = root / "training" / "label_2"
    frames = read_predictions(root.parent / predictions, read_truth(labels), labels)
    return matches_at_score(frames.truth, frames.detections, CLASSES, scores=0.3)


def draw(root: Path, count: int, *others: EvaluatedDetector) -> Path:
    folder = root.parent / "gallery"
    own = EvaluatedDetector("made up", root.parent / "det", match_detections(root))
    write_gallery(folder, [own, *others], count, KittiSplit(root), root / "training" / "label_2", GRID.ranges)
    return folder


def pixels(image: np.ndarray, color: tuple[int, int, int]) -> int:
    """Pixels of about this color beside the legend; lines of two colors may lie side by side."""
    return int((np.abs(image[:, 160:].astype(int) - color).max(axis=-1) < 50).sum())


def test_the_worst_frames_come_first_in_their_colors(root: Path) -> None:
    judged = match_detections(root)
    assert [frame.errors for frame in judged] == [0, 4, 1, 3]
    assert [frame.frame_id for frame in worst_frames(judged, 9)] == ["000001", "000003", "000002"]
    assert [frame.frame_id for frame in worst_frames(judged, 2)] == ["000001", "000003"]
    assert [frame.frame_id for frame in worst_frames(judged[::-1] * 2, 3)] == ["000001", "000001", "000003"]
    folder = draw(root, 3)
    names = ["001_000001.png", "002_000003.png", "003_000002.png"]
    assert sorted(path.name for path in folder.iterdir()) == [*names, "index.html"]
    assert title(folder / "index.html") == "made up: worst frames"
    index = (folder / "index.html").read_text()
    told = {"000001": (4, 0), "000003": (1, 2), "000002": (0, 1)}
    assert cards(index) == {one: {"errors": a + b, "missed": a, "false": b} for one, (a, b) in told.items()}
    assert sources(index) == [name for name in names for _ in range(2)]
    pictures = [np.asarray(cv2.imread(str(folder / name))) for name in names]
    colors = [[pixels(picture, color) > 100 for color in (RED, MAGENTA, GREEN)] for picture in pictures]
    assert colors == [[True, False, False], [True, True, True], [False, True, True]]


def test_the_image_stands_below_where_there_is_one(root: Path) -> None:
    alone = np.asarray(cv2.imread(str(draw(root, 1) / "001_000001.png")))
    path = KittiSplit(root).image_path("000001")
    path.parent.mkdir()
    cv2.imwrite(str(path), np.full((375, 1242, 3), 90, np.uint8))
    both = np.asarray(cv2.imread(str(draw(root, 1) / "001_000001.png")))
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
    worst = worst_frames(match_detections(root), 1)
    assert (worst[0].missed.sum(), worst[0].false_positive.sum()) == (4, 1) and len(read_labels(label)) == 5
    image = np.asarray(cv2.imread(str(draw(root, 1) / "001_000001.png")))
    assert pixels(image, MAGENTA) == 0 < pixels(image, RED)


def another(root: Path) -> EvaluatedDetector:
    """Another detector: the same; all found; one missed and one false; without predictions."""
    split, folder = KittiSplit(root), root.parent / "other"
    for frame_id in ("000000", "000001", "000002"):
        objects = scored(split.objects(frame_id))
        found = [*objects[:3], moved(objects[0])] if frame_id == "000002" else objects
        write_labels(folder / f"{frame_id}.txt", found)
    return EvaluatedDetector("another", folder, match_detections(root, "other"))


def test_two_detectors_are_compared_where_they_differ(root: Path) -> None:
    first, second = match_detections(root), another(root).frames
    assert [pair[0].frame_id for pair in most_different_frames(first, second, 9)] == ["000001", "000002"]
    assert [pair[0].frame_id for pair in most_different_frames(first, second, 1)] == ["000001"]
    assert most_different_frames(first, first, 9) == []


def test_two_detectors_stand_side_by_side_on_the_same_part_of_the_scan(root: Path) -> None:
    objects = scored(KittiSplit(root).objects("000001"))
    far = KittiObject(**(vars(objects[0]) | {"x_m": 0.0, "z_m": GRID.x_range_m[1]}))  # false, beyond all points
    write_labels(root.parent / "det" / "000001.txt", [far])
    folder = draw(root, 1, another(root))
    index = (folder / "index.html").read_text()
    assert title(folder / "index.html") == "made up and another: where they differ most"
    counts = {"missed, made up": 4, "false, made up": 1, "missed, another": 0, "false, another": 0}
    assert cards(index) == {"000001": {"difference": 5} | counts}
    assert sorted(path.name for path in folder.iterdir()) == ["001_000001.png", "index.html"]
    picture = np.asarray(cv2.imread(str(folder / "001_000001.png")))
    assert picture.shape[1] == 2000
    left, right = picture[:, :1000], picture[:, 1000:]
    assert pixels(left, RED) > 100 and pixels(left, MAGENTA) > 20 and pixels(left, GREEN) == 0
    assert pixels(right, GREEN) > 100 and pixels(right, RED) == pixels(right, MAGENTA) == 0
    # Most of the picture is the same points at the same places.
    assert (left[60:, 160:-4] == right[60:, 160:-4]).all(axis=-1).mean() > 0.9
