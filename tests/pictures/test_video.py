"""Videos: what they show, that they can be read, and what is said where there is no encoder."""

import importlib.util
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from asca_pillars.base.errors import AscaError, ConfigError
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.boxes import Ranges
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.pictures import video
from asca_pillars.pictures.video import BoxVideo, VideoFile, is_own_video
from asca_pillars.pictures.visualize import class_color
from tests.helpers.video_encoder import needs_encoder

RANGES = Ranges(x_m=(0.0, 40.0), y_m=(-20.0, 20.0), z_m=(-3.0, 1.0))
POINTS = np.array([[30.0, 5, -1.7, 0], [10, -4, 0, 0], [20, 0, 1, 0]], np.float32)


class Kept:
    """Takes pictures in a video's place."""

    def __init__(self) -> None:
        self.images: list[np.ndarray] = []

    def write(self, image: np.ndarray) -> None:
        self.images.append(image)


def car_at(x_m: float, y_m: float = 0.0) -> Detections:
    box = np.array([[x_m, y_m, -0.9, 4, 2, 1.6, 0]], np.float32)
    return Detections(box, np.ones(1, np.float32), np.zeros(1, np.int64), ("Car",))


def colored(image: np.ndarray, tolerance: int = 60) -> np.ndarray:
    return np.asarray((np.abs(image.astype(int) - class_color("Car")) <= tolerance).all(axis=-1))


@needs_encoder
@pytest.mark.parametrize("view", ["above", "chase"])
def test_a_video_is_read_back(tmp_path: Path, view: video.VideoView) -> None:
    with VideoFile(tmp_path / "a.mp4", 10) as file:
        shown = BoxVideo(file, view, RANGES)
        for step in range(5):
            shown.add(POINTS, car_at(30 - 5 * step), 7 + step / 10, np.array([3]))
    assert is_own_video(tmp_path / "a.mp4")
    read = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert read.get(cv2.CAP_PROP_FPS) == pytest.approx(10)
    images = [read.read()[1] for _ in range(int(read.get(cv2.CAP_PROP_FRAME_COUNT)))]
    assert len(images) == 5
    first, last = (np.nonzero(colored(image[80:], 70))[0].mean() for image in (images[0], images[-1]))
    assert last > first + 40  # it came nearer


@needs_encoder
def test_what_the_encoder_cannot_write_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"a\.mp4: ffmpeg failed \("), VideoFile(tmp_path / "none" / "a.mp4", 10) as file:
        for _ in range(100):
            file.write(np.zeros((400, 400, 3), np.uint8))
    with VideoFile(tmp_path / "b.mp4", 10) as file:
        file.write(np.zeros((41, 40, 3), np.uint8))
        with pytest.raises(ValueError, match="all have one size"):
            file.write(np.zeros((60, 40, 3), np.uint8))


def test_without_an_encoder_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(AscaError, match=r"needs ffmpeg, which is not here: pip install .*\[video\]"):
        VideoFile(tmp_path / "a.mp4", 10)
    (tmp_path / "mine.mp4").write_bytes(b"\0\0\0\x20ftypisom of mine")
    assert not is_own_video(tmp_path / "mine.mp4")


def test_pictures_keep_their_size_and_a_trail_follows_its_box() -> None:
    kept = Kept()
    shown = BoxVideo(kept, "above", RANGES)  # type: ignore[arg-type]
    shown.add(POINTS[:0], car_at(35), 0.0, np.array([1]))
    shown.add(POINTS, car_at(10), 0.5, np.array([1]))
    shown.add(POINTS, car_at(10)[:0], 1.0, np.array([], np.int64))
    assert len({image.shape for image in kept.images}) == 1
    between = [colored(image[150:600, 440:460], 130).any(axis=1).mean() for image in kept.images]
    assert between[0] < 0.25 < 0.9 < between[1] and between[2] == 0


def test_trails_end_after_some_seconds_and_stand_still_where_the_pose_is_known() -> None:
    shown = BoxVideo(Kept(), "above", RANGES)  # type: ignore[arg-type]
    for second in range(8):
        pose = np.eye(4)
        pose[0, 3] = 2.0 * second  # the car drives 2 m/s towards what stands
        (trail,) = shown._extend(car_at(30 - 2 * second), np.array([5]), float(second), pose)
    np.testing.assert_allclose(trail.places_m[:, 0], 30 - 14)
    assert len(trail.places_m) == 1 + video.TRAIL_S


def test_scans_of_a_turned_sensor_are_shown_level() -> None:
    turned = FrameChange(np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), np.zeros(3))  # y forward
    level, other = (BoxVideo(Kept(), "above", RANGES, change) for change in (None, turned))  # type: ignore[arg-type]
    straight = level.draw(POINTS, car_at(20, 3), 0.0, np.array([1]))
    found = car_at(20, 3)
    box = turned.inverse.boxes(found.boxes)
    there = Detections(box, found.scores, found.labels, found.class_names)
    assert (
        np.abs(straight.astype(int) - other.draw(turned.inverse.points(POINTS), there, 0.0, np.array([1]))).mean() < 0.1
    )


def test_there_are_two_views() -> None:
    with pytest.raises(ConfigError, match="--video-view side: give above or chase"):
        BoxVideo(Kept(), "side", RANGES)  # type: ignore[arg-type]
