"""What is counted when scans are moved by parts of a cell."""

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.frames import LabeledFrame
from asca_pillars.geometry.detections import Detections
from benchmarks.cell_shifts import SHIFTS_M, scores_by_shift

BOXES = np.array([[10, 0, -0.8, 0.8, 0.6, 1.7, 0], [10, 5, -0.8, 0.8, 0.6, 1.7, 0]], np.float32)
FRAME = LabeledFrame("000000", np.array([[10, 0, 0, 0], [10, 5, 0, 0]], np.float32), BOXES, np.zeros(2, np.int64))
CLASSES = ("Car", "Pedestrian")


def _finds_what_stands_on_a_whole_meter(points: NDArray[np.float32]) -> Detections:
    """Two detections of the first object, as a suppression might leave them, and a car where the second one is."""
    moved = points[:, :2] - FRAME.points[:, :2]
    boxes = BOXES[[0, 0, 1]].copy()
    boxes[:, :2] += moved[[0, 0, 1]]
    found = Detections(boxes, np.array([0.9, 0.8, 0.7], np.float32), np.array([1, 1, 0]), CLASSES)
    return found if not moved[0, 0] else Detections.empty(CLASSES)


def test_an_object_is_found_by_its_own_class_once_and_where_it_was_moved_to() -> None:
    scores = scores_by_shift(_finds_what_stands_on_a_whole_meter, FRAME, "Pedestrian")
    assert scores.shape == (len(SHIFTS_M) ** 2, 2)
    unmoved_along_x = scores[: len(SHIFTS_M)]
    np.testing.assert_allclose(unmoved_along_x[:, 0], 0.9, rtol=1e-6)
    assert not unmoved_along_x[:, 1].any(), "a car is no pedestrian"
    assert not scores[len(SHIFTS_M) :].any()
