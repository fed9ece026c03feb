"""Labels against points: bodies whose points are known, at any bearing."""

import numpy as np
import pytest

from asca_pillars.evaluation.errors.label_fit import STATISTICS, label_fit, view_angle_deg

CAR = np.array([20.0, 0.0, -0.9, 4.0, 1.6, 1.5, 0.0])
PERSON = np.array([12.0, 0.0, -0.8, 0.8, 0.6, 1.8, 0.4])
BOTTOM_M = -1.65


def rear_of_a_car() -> np.ndarray:
    """From 10 cm outside the label's near face; the flanks end 30 cm before the far face, the roof at the middle."""
    across, up = np.meshgrid(np.linspace(-0.75, 0.75, 31), np.linspace(0.3, 1.4, 12))
    rear = np.stack([np.full(across.size, 17.9), across.ravel(), BOTTOM_M + up.ravel()], axis=1)
    along, low = np.meshgrid(np.linspace(17.9, 21.7, 77), np.linspace(0.3, 0.8, 6))
    flank = np.stack([along.ravel(), np.full(along.size, 0.72), BOTTOM_M + low.ravel()], axis=1)
    roof = np.stack([np.linspace(18.2, 20.0, 40), np.zeros(40), np.full(40, BOTTOM_M + 1.25)], axis=1)
    return np.concatenate([rear, flank, roof])


def turned(points: np.ndarray, box: np.ndarray, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Both turned about the sensor."""
    matrix = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    return points @ matrix.T, np.concatenate([matrix @ box[:3], box[3:6], [box[6] + angle]])


def statistics(points: np.ndarray, *boxes: np.ndarray) -> list[dict[str, float]]:
    return [dict(zip(STATISTICS, row, strict=True)) for row in label_fit(points, np.array(boxes))]


@pytest.mark.parametrize("angle", [0.0, 0.9, 2.5, -1.6])
def test_a_car_from_behind_wherever_it_stands(angle: float) -> None:
    (fit,) = statistics(*turned(rear_of_a_car(), CAR, angle))
    assert fit["nearest_point"] == pytest.approx(-0.1)
    assert fit["flank_end"] == pytest.approx(-0.3, abs=0.1)  # a percentile below the last point
    assert fit["rear_width"] == pytest.approx(-0.1, abs=0.02)
    assert fit["top"] == pytest.approx(-0.1) and fit["top_97"] <= fit["top"]
    assert fit["low_inside"] == 0
    assert fit["upper_end"] == pytest.approx(0.5, abs=0.03)
    assert fit["roof_end"] == pytest.approx(2.0, abs=0.1)
    assert np.isnan(fit["range_50"]), "of things that are seen as a whole"


def test_a_roof_has_an_end_from_behind_alone_and_points_behind_the_glass_are_inside() -> None:
    front = np.add(CAR, [0, 0, 0, 0, 0, 0, np.pi])
    (behind,), (before,) = statistics(rear_of_a_car(), CAR), statistics(rear_of_a_car(), front)
    assert np.isnan(before["upper_end"]) and np.isnan(before["roof_end"])
    assert before["flank_end"] == pytest.approx(behind["flank_end"])
    seats = np.column_stack([np.linspace(20.3, 21, 8), np.linspace(-0.3, 0.3, 8), np.full(8, BOTTOM_M + 0.6)])
    (fit,) = statistics(np.concatenate([rear_of_a_car(), seats]), CAR)
    assert fit["low_inside"] == 1


def test_range_of_a_person_and_the_angle_of_view() -> None:
    rng = np.random.default_rng(0)
    points = np.array([11.8, 0, -0.8]) + rng.uniform(-1, 1, (400, 3)) * (0.1, 0.2, 0.6)
    for angle in (0.0, 2.0):
        (fit,) = statistics(*turned(points, PERSON, angle))
        assert fit["range_50"] == pytest.approx(-0.2, abs=0.02)
        assert fit["range_5"] == pytest.approx(-0.29, abs=0.02) and fit["range_95"] == pytest.approx(-0.11, abs=0.02)
        assert fit["range_spread"] == pytest.approx(0.2, abs=0.01)
        assert np.isnan(fit["flank_end"])
    bearings, turns = np.array([0.0, 1.0, -3.0, 0.5]), np.radians([0.0, 100, 170, -30])
    boxes = np.zeros((4, 7))
    boxes[:, 0], boxes[:, 1], boxes[:, 6] = 10 * np.cos(bearings), 10 * np.sin(bearings), bearings + turns
    np.testing.assert_allclose(view_angle_deg(boxes), [0, 80, 10, 30], atol=1e-6)


def test_what_an_object_does_not_allow_is_not_a_number() -> None:
    points = rear_of_a_car()
    far, aside, empty = (np.add(CAR, [x, y, 0, 0, 0, 0, turn]) for x, y, turn in ((20, 0, 0), (0, 0, 0.6), (0, 9, 0)))
    fits = label_fit(points, np.array([far, aside]))
    assert np.isnan(fits).all()
    (fit,) = statistics(points, empty)
    assert np.isnan([value for name, value in fit.items() if name != "low_inside"]).all()
    assert label_fit(points, np.zeros((0, 7))).shape == (0, len(STATISTICS))
