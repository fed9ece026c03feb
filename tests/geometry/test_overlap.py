"""Overlaps against shapely."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from asca_pillars.geometry.overlap import (
    aligned_bev_iou,
    bev_intersection,
    bev_iou,
    iou_3d,
    paired_bev_intersection,
    paired_bev_touch,
    paired_iou_3d,
)
from tests.geometry.overlap_oracles import bev_iou_twin, intersection_twin, moved, polygon, random_boxes

# Places up to 70 m away, sizes from a thin plate to a lorry.
CENTERS = st.tuples(st.floats(-70, 70), st.floats(-70, 70), st.floats(-2, 1))
SIZES = st.tuples(*[st.sampled_from([1e-3, 0.6, 1.6, 4.0, 20.0]) | st.floats(0.01, 20)] * 3)
YAWS = st.floats(-7, 7) | st.sampled_from([k * math.pi / 4 for k in range(-4, 5)] + [1e-320, 1e-9])
BOXES = st.builds(lambda c, s, yaw: np.array([*c, *s, yaw]), CENTERS, SIZES, YAWS)


def iou_3d_twin(a: np.ndarray, b: np.ndarray) -> float:
    top, bottom = min(a[2] + a[5] / 2, b[2] + b[5] / 2), max(a[2] - a[5] / 2, b[2] - b[5] / 2)
    shared = intersection_twin(a, b) * max(0.0, top - bottom)
    return float(shared / (np.prod(a[3:6]) + np.prod(b[3:6]) - shared))


def assert_overlaps(a: np.ndarray, b: np.ndarray) -> None:
    """All three measures of one pair, both ways round."""
    for first, second in ((a, b), (b, a)):
        (area,), (flat,), (solid,) = (f(first[None], second[None])[0] for f in (bev_intersection, bev_iou, iou_3d))
        assert area == pytest.approx(intersection_twin(a, b), abs=1e-6)
        assert flat == pytest.approx(bev_iou_twin(a, b), abs=1e-6)
        assert solid == pytest.approx(iou_3d_twin(a, b), abs=1e-6)
        assert 0 <= solid <= flat + 1e-12 <= 1 + 2e-12
        assert 0 <= area <= min(a[3] * a[4], b[3] * b[4]) * (1 + 1e-12)


@settings(max_examples=60)
@given(BOXES, st.sampled_from([0.0, 1e-12, -1e-9, 1e-6]), st.sampled_from([0.0, 1e-12, 1e-9, -1e-7, math.pi]))
def test_nearly_equal_boxes(a: np.ndarray, shift: float, turn: float) -> None:
    assert_overlaps(a, moved(a, shift, -shift, turn=turn))


@settings(max_examples=150)
@given(BOXES, st.floats(-3, 3), st.floats(-3, 3), st.floats(-2, 2), SIZES, YAWS)
def test_nearby_boxes(a: np.ndarray, dx: float, dy: float, dz: float, size: tuple[float, ...], yaw: float) -> None:
    assert_overlaps(a, np.array([a[0] + dx, a[1] + dy, a[2] + dz, *size, yaw]))


@settings(max_examples=60)
@example(np.array([0, 0, 0, 1e-3, 1.6, 1e-3, 3 * math.pi / 4]), math.nextafter(1, 0), 0.0, 0.0)
@given(BOXES, st.floats(0.05, 1), st.floats(-1, 1), st.floats(-1, 1))
def test_nested_boxes(a: np.ndarray, scale: float, along: float, across: float) -> None:
    """A smaller box with the same yaw, moved inside as far as it goes; at +-1 their sides touch."""
    inner = a * [1, 1, 1, scale, scale, scale, 1]
    dx, dy = along * (a[3] - inner[3]) / 2, across * (a[4] - inner[4]) / 2
    inner[:2] += dx * math.cos(a[6]) - dy * math.sin(a[6]), dx * math.sin(a[6]) + dy * math.cos(a[6])
    assert_overlaps(a, inner)
    assert bev_intersection(a[None], inner[None])[0, 0] == pytest.approx(inner[3] * inner[4], rel=1e-6, abs=1e-9)


@settings(max_examples=60)
@given(BOXES, SIZES, st.sampled_from([0.0, 1e-3, 5.0]))
def test_touching_and_disjoint_boxes(a: np.ndarray, size: tuple[float, ...], gap: float) -> None:
    # Side by side: b stands in front of a.
    b = np.array([*a[:3], *size, a[6]])
    forward = (a[3] + b[3]) / 2 + gap
    b[:2] += forward * math.cos(a[6]), forward * math.sin(a[6])
    assert_overlaps(a, b)
    if gap:
        for first, second in ((a, b), (b, a)):
            assert bev_intersection(first[None], second[None])[0, 0] == 0.0
            assert iou_3d(first[None], second[None])[0, 0] == 0.0


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_boxes_that_do_not_meet_share_exactly_nothing(seed: int) -> None:
    a, b = random_boxes(seed, 12, 12.0).astype(np.float64), random_boxes(seed + 1, 12, 12.0).astype(np.float64)
    shared = bev_intersection(a, b)
    for row, column in np.ndindex(shared.shape):
        meet = polygon(a[row]).distance(polygon(b[column])) < 1e-9
        assert (shared[row, column] > 0) == meet


@settings(max_examples=40)
@given(BOXES)
def test_a_box_and_itself(a: np.ndarray) -> None:
    for box in (a, a.astype(np.float32)):
        assert bev_iou(box[None], box[None]).tolist() == [[1.0]]
        assert iou_3d(box[None], box[None]).tolist() == [[1.0]]
    half_turn = moved(a, turn=math.pi)
    assert iou_3d(a[None], half_turn[None])[0, 0] == pytest.approx(1.0, abs=1e-9)


def test_pairs_are_the_diagonal_and_boxes_without_area_overlap_nothing() -> None:
    a, b = random_boxes(0, 40, 3.0).astype(np.float64), random_boxes(1, 40, 3.0).astype(np.float64)
    np.testing.assert_array_equal(paired_bev_intersection(a, b), np.diag(bev_intersection(a, b)))
    np.testing.assert_array_equal(paired_iou_3d(a, b), np.diag(iou_3d(a, b)))
    assert paired_iou_3d(a[:0], b[:0]).shape == (0,)
    flat = np.array([[1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.5]])
    for measure in (bev_iou, iou_3d, aligned_bev_iou):
        assert measure(flat, flat).tolist() == [[0.0]]


def test_footprints_apart_do_not_touch() -> None:
    box = np.array([10.0, 2.0, 0, 4.0, 2.0, 1.5, 0.3])
    # Turned by 0.3, 2.2 to the side is 2.10 across its width of 2, and 2.0 is 1.91.
    for dx, dy, touch in ((5.0, 0.0, False), (0.0, 2.2, False), (0.0, 2.0, True)):
        assert paired_bev_touch(box[None], moved(box, dx, dy)[None])[0] == touch


@given(BOXES, BOXES)
def test_footprints_touch_where_they_share_area(a: np.ndarray, b: np.ndarray) -> None:
    for first, second in ((a, b), (a, moved(a, dx=a[3] * 0.9))):
        shared = intersection_twin(first, second)
        touch = bool(paired_bev_touch(first[None], second[None])[0])
        assert touch == bool(paired_bev_touch(second[None], first[None])[0])
        assert touch or shared < 1e-6  # less than that is rounding, in shapely as well as here
        assert touch or not paired_bev_intersection(first[None], second[None])[0]


@pytest.mark.parametrize("measure", [bev_intersection, bev_iou, iou_3d, aligned_bev_iou])
@pytest.mark.parametrize(("rows", "columns"), [(0, 0), (0, 3), (3, 0), (7, 5)])
def test_any_number_of_boxes_that_stay_as_they_are(measure, rows: int, columns: int) -> None:  # type: ignore[no-untyped-def]
    a, b = random_boxes(0, rows, 8.0).astype(np.float64), random_boxes(1, columns, 8.0).astype(np.float64)
    before = a.copy(), b.copy()
    assert measure(a, b).shape == (rows, columns)
    assert np.array_equal(a, before[0]) and np.array_equal(b, before[1])


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_aligned_iou_turns_to_the_nearest_axis(seed: int) -> None:
    a, b = random_boxes(seed, 6, 6.0), random_boxes(seed + 1, 9, 6.0)
    turned_a, turned_b = a.copy(), b.copy()
    for boxes in (turned_a, turned_b):
        boxes[:, 6] = np.round(boxes[:, 6] / (math.pi / 2)) * (math.pi / 2)
    result = aligned_bev_iou(a, b)
    assert result.dtype == np.float32
    np.testing.assert_allclose(result, bev_iou(turned_a, turned_b), atol=2e-5)
    np.testing.assert_array_equal(np.diag(aligned_bev_iou(a, a)), 1.0)
