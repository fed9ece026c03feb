"""Anchors of one map, and boxes that lie among them."""

import math

import numpy as np
from hypothesis import strategies as st

from asca_pillars.detection.anchors import IGNORED, KITTI_CLASSES, make_anchors
from asca_pillars.detection.targets import Targets
from asca_pillars.ops.pillar.grid import PillarGrid

# Rectangular, asymmetric, both minima off zero. Head cells are 0.32 m along y and 0.64, 0.32, 0.16 m along x in
# the zones that begin at 2.00, 4.56 and 7.12 m: 16 rows, 4 + 8 + 16 columns.
GRID = PillarGrid(x_range_m=(2.0, 9.68), y_range_m=(-1.92, 3.2))
ANCHORS = make_anchors(*GRID.head_centers_m(), KITTI_CLASSES)
ROWS, COLUMNS, COUNT = 16, 28, 6
CAR, PEDESTRIAN, CYCLIST = range(3)
SIZES = {CAR: (3.9, 1.6, 1.56), PEDESTRIAN: (0.8, 0.6, 1.73), CYCLIST: (1.76, 0.6, 1.73)}


def places(targets: Targets, state: int) -> set[tuple[int, ...]]:
    """(row, column, anchor) wherever the state is this."""
    return set(map(tuple, np.argwhere(targets.state == state).tolist()))


@st.composite
def labelled_boxes(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """Up to six boxes in and around the grid, about as large as one of the classes."""
    labels = draw(st.lists(st.sampled_from([IGNORED, CAR, PEDESTRIAN, CYCLIST]), max_size=6))
    boxes = []
    for label in labels:
        like = label if label != IGNORED else draw(st.sampled_from([CAR, PEDESTRIAN, CYCLIST]))
        stretch = [draw(st.floats(0.6, 1.8)) for _ in range(3)]
        center = draw(st.floats(-2.0, 14.0)), draw(st.floats(-5.0, 6.0)), draw(st.floats(-2.0, 0.5))
        boxes.append([*center, *np.multiply(SIZES[like], stretch), draw(st.floats(-math.pi, 3.14))])
    return np.array(boxes, np.float32).reshape(-1, 7), np.array(labels, np.int64)
