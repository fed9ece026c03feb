"""Boxes beside the grid are no targets: no anchor stands where they are."""

import numpy as np

from asca_pillars.data.frames import LabeledFrame, within_ranges
from tests.helpers.scenes import GRID


def test_boxes_are_kept_by_their_center() -> None:
    (x0, x1), (y0, y1) = GRID.x_range_m, GRID.y_range_m
    centers = [(x0, y0), (x1 - 0.01, y1 - 0.01), (x0 - 0.01, 0.0), (x1, 0.0), (10.0, y0 - 0.01), (10.0, y1)]
    boxes = np.array([[x, y, 0, 4, 2, 1.5, 0] for x, y in centers], np.float32)
    frame = LabeledFrame("000000", np.empty((0, 4), np.float32), boxes, np.arange(6))
    kept = within_ranges(frame, GRID.ranges)
    assert kept.labels.tolist() == [0, 1] and np.array_equal(kept.boxes, boxes[:2])
    assert len(frame.boxes) == 6
