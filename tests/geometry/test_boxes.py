"""The drawing in boxes.py, by hand and against shapely."""

import math

import numpy as np
import pytest
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st

from asca_pillars.geometry.boxes import corners, footprints, points_in_boxes, wrap_angle
from tests.geometry.drawn_boxes import random_boxes

# A car at (10, 2), 4 m long and 2 m wide, heading forward, and the same heading left.
FORWARD = [10.0, 2.0, -1.0, 4.0, 2.0, 1.5, 0.0]
LEFT = [10.0, 2.0, -1.0, 4.0, 2.0, 1.5, math.pi / 2]


def test_footprints_by_hand() -> None:
    first, second = footprints(np.array([FORWARD, LEFT]))
    # Front-left, rear-left, rear-right, front-right; y grows to the left.
    np.testing.assert_allclose(first, [[12, 3], [8, 3], [8, 1], [12, 1]], atol=1e-12)
    # Heading left, the front is at high y, and the box's left side faces backwards.
    np.testing.assert_allclose(second, [[9, 4], [9, 0], [11, 0], [11, 4]], atol=1e-12)
    assert first.dtype == corners(np.array([FORWARD])).dtype == np.float64


def test_footprints_run_counter_clockwise_and_corners_stack_them() -> None:
    boxes = random_boxes(0, 50)
    for polygon, box in zip(footprints(boxes), boxes, strict=True):
        ring = shapely.LinearRing(polygon)
        assert ring.is_ccw
        np.testing.assert_allclose(shapely.Polygon(polygon).area, box[3] * box[4], rtol=1e-4)
        heading = (polygon[0] + polygon[3] - polygon[1] - polygon[2]) / 2
        np.testing.assert_allclose(heading, box[3] * np.array([np.cos(box[6]), np.sin(box[6])]), atol=1e-4)
    boxes = random_boxes(1, 20)
    stacked = corners(boxes)
    assert stacked.shape == (20, 8, 3) and stacked.dtype == np.float32
    np.testing.assert_array_equal(stacked[:, :4, :2], footprints(boxes))
    np.testing.assert_array_equal(stacked[:, 4:, :2], footprints(boxes))
    np.testing.assert_allclose(stacked[:, :4, 2], np.repeat(boxes[:, 2:3] - boxes[:, 5:6] / 2, 4, axis=1))
    np.testing.assert_allclose(stacked[:, 4:, 2], np.repeat(boxes[:, 2:3] + boxes[:, 5:6] / 2, 4, axis=1))


def test_points_in_a_box_by_hand() -> None:
    inside = [(10.0, 2.0, -1.0), (11.99, 2.99, -0.26), (12.0, 2.0, -1.0)]  # the last on the front face
    outside = [(12.01, 2.0, -1.0), (10.0, 3.01, -1.0), (10.0, 2.0, -0.24), (10.0, 2.0, -1.76), (math.nan, 2.0, -1.0)]
    found = points_in_boxes(np.array([*inside, *outside, (10.0, 2.0, math.inf)]), np.array([FORWARD]))
    assert found[:, 0].tolist() == [True] * 3 + [False] * 6


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1), st.floats(0, 2))
def test_points_in_boxes_equals_shapely(seed: int, margin_m: float) -> None:
    boxes = random_boxes(seed, 6)
    rng = np.random.default_rng(seed)
    # Points around the boxes, so that many fall inside.
    points = boxes[rng.integers(0, 6, 200), :3] + rng.normal(0, 2, (200, 3)).astype(np.float32)
    inside = points_in_boxes(points, boxes, margin_m)
    assert inside.shape == (200, 6) and inside.dtype == bool
    for column, box in enumerate(boxes.astype(np.float64)):
        grown = box + 2 * margin_m * np.array([0, 0, 0, 1, 1, 1, 0])
        polygon = shapely.Polygon(footprints(grown[None])[0])
        distance = shapely.distance(polygon.boundary, shapely.points(points[:, :2].astype(np.float64)))
        to_face = np.abs(np.abs(points[:, 2] - box[2]) - grown[5] / 2)
        clear = (distance > 1e-5) & (to_face > 1e-5)  # within rounding of a face either answer is right
        expected = shapely.contains_xy(polygon, points[:, 0], points[:, 1])
        expected &= np.abs(points[:, 2] - box[2]) <= grown[5] / 2
        np.testing.assert_array_equal(inside[clear, column], expected[clear])


def test_no_boxes_and_no_points() -> None:
    none, one = np.empty((0, 7), np.float32), np.array([FORWARD], np.float32)
    assert footprints(none).shape == (0, 4, 2)
    assert corners(none).shape == (0, 8, 3)
    assert points_in_boxes(np.zeros((5, 4)), none).shape == (5, 0)
    assert points_in_boxes(np.empty((0, 4)), one).shape == (0, 1)


@given(st.floats(-1e4, 1e4), st.sampled_from([2 * math.pi, math.pi, 1.0]), st.sampled_from([np.float32, float]))
@example(-0.5, 1.0, np.float32)  # a lower end that float32 holds exactly
@example(math.nextafter(math.pi, 0), 2 * math.pi, np.float64)
def test_wrapped_angles_differ_by_whole_periods(angle: float, period: float, dtype: type) -> None:
    angle = dtype(angle)
    wrapped = wrap_angle(angle, period)
    assert wrapped.dtype == np.dtype(dtype)
    assert -period / 2 <= float(wrapped) < period / 2
    turns = (float(angle) - float(wrapped)) / period
    assert abs(turns - round(turns)) < 1e-6
    if -period / 2 <= float(angle) < period / 2:
        assert wrapped == angle
    assert wrap_angle(wrapped, period) == wrapped
    for shape in ((1, 2), (0, 3)):
        assert np.array_equal(wrap_angle(np.full(shape, angle), period), np.full(shape, wrapped))


@pytest.mark.parametrize("angle", [-math.pi, math.pi, 3 * math.pi, np.nextafter(-math.pi, -4), -1e-20, 0.0])
def test_wrapping_at_the_border(angle: float) -> None:
    for value in (np.float64(angle), np.float32(angle)):
        wrapped = float(wrap_angle(value))
        assert -math.pi <= wrapped < math.pi
        assert abs(math.sin(wrapped) - math.sin(angle)) < 1e-6 and abs(math.cos(wrapped) - math.cos(angle)) < 1e-6
