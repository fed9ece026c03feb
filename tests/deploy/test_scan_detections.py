"""What a detector's result adds to its boxes: KITTI text, pictures, a notebook's view."""

import copy

import cv2
import numpy as np
import pytest

from asca_deploy.scan_detections import ScanDetections
from asca_pillars.detection.detections import FrameReport, ScanCounts
from asca_pillars.geometry.boxes import Ranges
from tests.helpers.cameras import make_calibration
from tests.helpers.sent import sent

REPORT = FrameReport({"input": 1.0}, 0.0, ScanCounts(500, 0, 0), 0, 0, 0, ())
THREE = ScanDetections(
    boxes=np.array([[3.0, -4.0, 0, 4, 2, 1.5, 0], [8, 6, 0, 1, 1, 2, 1], [-5, 12, 0, 2, 1, 2, 2]], np.float32),
    scores=np.array([0.9, 0.6, 0.3], np.float32),
    labels=np.array([0, 2, 1]),
    class_names=("Car", "Pedestrian", "Cyclist"),
    report=REPORT,
    ranges=Ranges((-20, 20), (-20, 20), (-3, 3)),
)


def test_kitti_text_holds_what_the_camera_sees() -> None:
    lines = [line.split() for line in THREE.to_kitti(make_calibration()).splitlines()]
    assert [(words[0], words[15]) for words in lines] == [
        ("Car", "0.900000"),
        ("Cyclist", "0.600000"),
    ]  # the pedestrian is behind


def test_a_picture_without_points_shows_the_boxes() -> None:
    assert THREE.plot(width_px=200).shape[1:] == (200, 3)
    assert THREE[:0].plot(width_px=200).shape[1:] == (200, 3)
    assert THREE._repr_png_() is None
    assert "<td>Cyclist</td>" in THREE._repr_html_() and "<img" not in THREE._repr_html_()


def test_a_plot_is_a_picture_in_a_notebook() -> None:
    picture = THREE.plot(np.random.default_rng(0).uniform(-20, 20, (500, 4)), labels=THREE.boxes + 1)
    shown = cv2.imdecode(np.frombuffer(picture._repr_png_(), np.uint8), cv2.IMREAD_COLOR)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(shown, picture)
    assert picture[0]._repr_png_() is None  # type: ignore[attr-defined]  # a row of it is no picture


def test_a_part_has_the_same_report() -> None:
    part = THREE[THREE.scores > 0.5]
    assert isinstance(part, ScanDetections) and part.report is REPORT and part.names == ["Car", "Cyclist"]


def test_they_can_be_copied_and_sent_to_other_processes() -> None:
    for other in (sent(THREE), copy.deepcopy(THREE)):
        assert list(other) == list(THREE) and other.report == REPORT and other._repr_png_() is None


def test_the_view_in_3d_is_another_picture_of_the_same_scan() -> None:
    points = np.random.default_rng(0).uniform(-20, 20, (500, 4))
    picture = THREE.plot(points, view="chase", width_px=320)
    assert picture.shape == (180, 320, 3)
    with pytest.raises(ValueError, match="there are 'above' and 'chase'"):
        THREE.plot(points, view="below")  # type: ignore[arg-type]
