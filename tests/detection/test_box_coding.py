"""Boxes as the network learns them: encoding and decoding as an inverse pair."""

import math

import numpy as np
import pytest

from asca_pillars.geometry.boxes import decode_boxes, encode_boxes, wrap_angle

# Anchors of a car at yaw 0 and at 90 degrees.
CAR_ANCHORS = np.array(
    [[20.0, -7.0, -1.0, 3.9, 1.6, 1.56, 0.0], [20.0, -7.0, -1.0, 3.9, 1.6, 1.56, math.pi / 2]], np.float32
)


def random_boxes(seed: int, count: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    low, high = [18.0, -9.0, -2.0, 0.3, 0.3, 0.5, -math.pi], [22.0, -5.0, 0.0, 12.0, 3.0, 4.0, math.pi]
    return rng.uniform(low, high, (count, 7)).astype(np.float32)


def assert_same_boxes(boxes: np.ndarray, expected: np.ndarray) -> None:
    assert boxes.dtype == np.float32
    np.testing.assert_allclose(boxes[..., :6], expected[..., :6], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(wrap_angle(boxes[..., 6] - expected[..., 6]), 0, atol=2e-6)
    assert (boxes[..., 6] >= -math.pi).all() and (boxes[..., 6].astype(np.float64) < math.pi).all()


def test_residuals_by_hand() -> None:
    diagonal = math.hypot(3.9, 1.6)
    box = np.array([20.0 + diagonal / 2, -7.0 - diagonal / 4, -1.0 + 1.56 / 2, 3.9 * math.e, 1.6, 1.56 / math.e, 0.3])
    residuals, direction = encode_boxes(box[None], CAR_ANCHORS)
    np.testing.assert_allclose(residuals[0], [0.5, -0.25, 0.5, 1.0, 0.0, -1.0, 0.3], atol=1e-6)
    np.testing.assert_allclose(residuals[1], [0.5, -0.25, 0.5, 1.0, 0.0, -1.0, 0.3 - math.pi / 2], atol=1e-6)
    assert residuals.dtype == np.float32 and direction.dtype == np.int64
    assert direction.tolist() == [1, 1]


@pytest.mark.parametrize(
    ("offset", "degrees", "expected"),
    [
        (math.pi / 4, [44, 46, 134, 224, 226, 359, -1, -134, -136], [1, 0, 0, 0, 1, 1, 1, 1, 0]),
        (-math.pi / 2, [-91, -89, 0, 89, 91, 180], [1, 0, 0, 0, 1, 1]),
    ],
)
def test_directions_change_where_the_bins_begin(offset: float, degrees: list[int], expected: list[int]) -> None:
    boxes = np.tile(CAR_ANCHORS[0], (len(degrees), 1))
    boxes[:, 6] = np.radians(degrees)
    for anchor in CAR_ANCHORS:
        assert encode_boxes(boxes, anchor, offset)[1].tolist() == expected


@pytest.mark.parametrize("offset", [math.pi / 4, -math.pi / 2, 0.0, math.pi])
@pytest.mark.parametrize("anchor", CAR_ANCHORS)
def test_every_yaw_survives(anchor: np.ndarray, offset: float) -> None:
    # A full turn in steps that fall on the borders of the bins too, where rounding could turn a box round.
    yaws = np.concatenate([np.arange(0, 721) * math.pi / 360, -math.pi + np.arange(16) * math.pi / 8])
    yaws = np.concatenate([np.nextafter(yaws, -10), yaws, np.nextafter(yaws, 10)])
    boxes = np.tile(anchor.astype(np.float64), (len(yaws), 1))
    boxes[:, 6] = yaws
    for dtype in (np.float64, np.float32):
        residuals, direction = encode_boxes(boxes.astype(dtype), anchor, offset)
        assert (np.abs(residuals[:, 6]) <= np.float32(math.pi)).all()
        assert_same_boxes(decode_boxes(residuals, direction, anchor, offset), boxes)


@pytest.mark.parametrize("turns", [-1.0, -0.5, 0.0, 0.5, 1.0])
def test_boxes_survive_and_only_the_direction_tells_front_from_back(turns: float) -> None:
    # The loss cannot see half turns of the yaw residual. Away from the bins' borders the box is the same.
    boxes = random_boxes(3, 400)
    from_border = np.abs(wrap_angle(boxes[:, 6] - math.pi / 4, math.pi))
    boxes = boxes[from_border > 1e-5]
    for anchor in CAR_ANCHORS:
        residuals, direction = encode_boxes(boxes, anchor)
        residuals[:, 6] += turns * 2 * math.pi
        assert_same_boxes(decode_boxes(residuals, direction, anchor), boxes)
        turned = boxes + np.array([0, 0, 0, 0, 0, 0, math.pi], np.float32)
        assert_same_boxes(decode_boxes(residuals, 1 - direction, anchor), turned)


def test_no_boxes_and_sizes_that_stay_finite() -> None:
    none = np.empty((0, 7), np.float32)
    residuals, direction = encode_boxes(none, none)
    assert residuals.shape == (0, 7) and direction.shape == (0,)
    assert decode_boxes(residuals, direction, none).shape == (0, 7)
    residuals = np.zeros((2, 7), np.float32)
    residuals[:, 3:6] = [[1000.0, 89.0, np.inf], [-1000.0, -89.0, -np.inf]]
    boxes = decode_boxes(residuals, np.zeros(2, np.int64), CAR_ANCHORS[:1])
    np.testing.assert_allclose(boxes[0, 3:6], [390, 160, 156], rtol=1e-5)
    np.testing.assert_allclose(boxes[1, 3:6], [0.039, 0.016, 0.0156], rtol=1e-5)
