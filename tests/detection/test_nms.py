"""Suppression against its definition."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_pillars.detection.decode import rotated_nms
from tests.geometry.overlap_oracles import bev_iou_twin, random_boxes


def nms_twin(boxes: np.ndarray, scores: np.ndarray, threshold: float) -> list[int]:
    """The definition: walk down the scores, keep what no kept box overlaps too much; by shapely if they may meet."""
    reach = np.hypot(boxes[:, 3], boxes[:, 4]) / 2
    kept: list[int] = []
    for index in sorted(range(len(boxes)), key=lambda i: -scores[i]):
        apart = np.hypot(*(boxes[kept, :2] - boxes[index, :2]).T)
        near = np.flatnonzero(apart < reach[kept] + reach[index])
        if all(bev_iou_twin(boxes[index], boxes[kept[other]]) <= threshold for other in near):
            kept.append(index)
    return kept


@settings(max_examples=30)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 150),
    st.sampled_from([2.0, 10.0, 40.0]),
    st.sampled_from([0.01, 0.2, 0.5, 0.8]),
    st.booleans(),
)
def test_suppression_equals_its_definition(
    seed: int, count: int, spread_m: float, threshold: float, ties: bool
) -> None:
    boxes = random_boxes(seed, count, spread_m).astype(np.float64)
    scores = np.random.default_rng(seed).normal(size=count)
    if ties:
        scores = np.round(scores)
    kept = rotated_nms(boxes, scores, threshold)
    assert kept.dtype == np.int64
    assert kept.tolist() == nms_twin(boxes, scores, threshold)


def test_a_suppressed_box_suppresses_nothing() -> None:
    # A row of three, each half over the next: the middle one falls to the first and so spares the last.
    boxes = np.array([[10.0 + 1.2 * k, 1.0, 0.0, 2.0, 1.0, 1.0, 0.0] for k in range(3)])
    assert rotated_nms(boxes, np.array([0.9, 0.8, 0.7]), 0.2).tolist() == [0, 2]
    assert rotated_nms(boxes, np.array([0.7, 0.8, 0.9]), 0.2).tolist() == [2, 0]
    assert rotated_nms(boxes, np.array([0.7, 0.9, 0.8]), 0.2).tolist() == [1]


def test_of_equal_scores_the_earlier_stays() -> None:
    boxes = np.repeat(random_boxes(0, 1, 1.0), 130, axis=0)
    assert rotated_nms(boxes, np.full(130, 0.5, np.float32), 0.5).tolist() == [0]
    boxes[:, 0] += 10 * np.arange(130)
    assert rotated_nms(boxes, np.full(130, 0.5, np.float32), 0.5).tolist() == list(range(130))


def test_suppression_of_nothing() -> None:
    kept = rotated_nms(np.empty((0, 7), np.float32), np.empty(0, np.float32), 0.1)
    assert kept.shape == (0,) and kept.dtype == np.int64
