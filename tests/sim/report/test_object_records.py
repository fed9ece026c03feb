"""Records of labelled objects, by hand."""

import numpy as np
import pytest

from asca_pillars.data.kitti import KittiObject, objects_from_boxes
from asca_pillars.detection.detections import Detections
from asca_pillars.sim.report.like_for_like import record_objects, seen_objects
from tests.helpers.scenes import CALIBRATION

NAMES = ("Car", "Pedestrian")
BOX = np.array([[20.0, 0.0, -1.0, 4.0, 2.0, 2.0, np.pi / 2]], np.float32)


def labels(boxes: np.ndarray, names: tuple[str, ...]) -> list[KittiObject]:
    return objects_from_boxes(boxes, names, CALIBRATION)


def test_shares_and_scores_of_objects() -> None:
    # The box stands across: its length is along y, from -2 to 2; its bottom is at -2.
    points = np.array(
        [
            [20.0, -1.5, -1.9, 0.1],  # 5 % of the height
            [20.0, -0.5, -1.6, 0.6],  # 20 %
            [20.0, 0.5, -1.5, 0.9],  # 25 %
            [20.0, 1.5, -0.8, 0.2],  # 60 %
            [20.0, 4.0, -0.8, 0.9],  # beside it
        ],
        np.float32,
    )
    (record,) = record_objects(points, labels(BOX, ("Car",)), BOX, None)
    assert (record.class_name, record.points, record.pillars) == ("Car", 4, 4)
    assert record.distance_m == pytest.approx(20.0) and record.view_deg == pytest.approx(90.0, abs=1e-4)
    assert (record.lowest, record.wheels, record.middle) == (0.25, 0.5, 0.25)
    assert record.length_m == pytest.approx(3.0) and record.bright == 0.5
    assert np.isnan(record.score)
    points = np.array([[20.0, 0.0, -1.0, 0.1]], np.float32)
    aside = BOX + np.array([0, 9, 0, 0, 0, 0, 0], np.float32)
    found = Detections(
        np.concatenate([BOX, BOX + 0.1, aside, BOX]).astype(np.float32),
        np.array([0.4, 0.6, 0.9, 0.8], np.float32),
        np.array([0, 0, 0, 1]),
        NAMES,
    )
    (record,) = record_objects(points, labels(BOX, ("Car",)), BOX, found)
    assert record.score == pytest.approx(0.6)
    (record,) = record_objects(points, labels(BOX, ("Car",)), BOX, Detections.empty(NAMES))
    assert record.score == 0.0


def test_only_objects_with_returns_of_the_classes_that_the_image_shows() -> None:
    boxes = np.concatenate([BOX, BOX, -BOX]).astype(np.float32)
    boxes[2, 3:6] = BOX[0, 3:6]
    objects = labels(boxes, ("Car", "Van", "Car"))
    assert seen_objects(objects) == objects[:2]
    assert record_objects(np.zeros((0, 4), np.float32), objects, boxes, None) == []
    points = np.array([[20.0, 0.0, -1.0, 0.1]], np.float32)
    assert [record.class_name for record in record_objects(points, objects, boxes, None)] == ["Car"]
