import numpy as np
import pytest
from numpy.typing import NDArray

from asca_pillars.data.expected_input import ExpectedInput, InputWarning, check_input, measure_expected_input
from asca_pillars.pillars.grid import PillarGrid
from asca_pillars.pillars.pillarize import PillarLimits, pillarize

Points = NDArray[np.float32]
GRID = PillarGrid(x_range_m=(0.0, 23.04), y_range_m=(-7.68, 10.24))


def street(seed: int = 0, ground: float = -1.7, count: int = 4000) -> Points:
    """Flat ground with a wall along one side."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((0, -7.6, ground - 0.05, 0.1), (23, 10.2, ground + 0.05, 0.5), (count, 4))
    points[: count // 3, 1:3] = rng.uniform((9.5, ground), (10, ground + 3), (count // 3, 2))
    return points.astype(np.float32)


EXPECTED = measure_expected_input([street(1), street(2, ground=-1.8, count=5000)], camera_view=False)


def check(points: Points, expected: ExpectedInput = EXPECTED) -> list[InputWarning]:
    return check_input(points, pillarize(points, GRID, PillarLimits()).stats, expected)


def test_what_is_expected() -> None:
    assert EXPECTED.points_per_scan == (4000, 5000)
    assert EXPECTED.reflectance_mean == pytest.approx((0.3, 0.3), abs=0.01)  # uniform in 0.1..0.5
    assert EXPECTED.ground_z_m == pytest.approx((-1.8, -1.7), abs=0.05)


def test_a_scan_like_the_training_scans() -> None:
    assert check(street(3)) == []


def test_too_few_points_near_the_sensor_to_see_the_ground() -> None:
    far = street()
    far[:, 0] += 100
    assert measure_expected_input([far], False).ground_z_m is None
    assert check(street(), measure_expected_input([far, far], False)) == []


@pytest.mark.parametrize(("scale", "advice"), [(255, "divide it by 255"), (65535, "divide it by 65535")])
def test_reflectance_on_another_scale(scale: float, advice: str) -> None:
    points = street(5)
    points[:, 3] *= scale
    (warning,) = check(points)
    assert warning.about == "reflectance"
    assert advice in warning.text


def test_no_reflectance() -> None:
    points = street(5)
    points[:, 3] = 0
    (warning,) = check(points)
    assert warning.about == "reflectance"
    assert "mean reflectance is 0," in warning.text


@pytest.mark.parametrize("shift_m", [-1.2, 0.9])
def test_sensor_at_another_height(shift_m: float) -> None:
    points = street(6, ground=-1.75)
    points[:, 2] += shift_m
    (warning,) = check(points)
    assert warning.about == "height"
    added = float(warning.text.split("add ")[1].split(" m")[0])
    points[:, 2] += added  # the advice works
    assert check(points) == []
    assert added == pytest.approx(-shift_m, abs=0.1)


def test_axes_swapped() -> None:
    points = street(7)
    points[:, :2] = np.stack([-points[:, 0] - 1, points[:, 1]], axis=1)  # x backward
    (warning,) = check(points)
    assert warning.about == "range"
    assert warning.text.startswith("100.0 % of the points lie outside the grid")


@pytest.mark.parametrize("count", [0, 1, 399])
def test_too_few_points(count: int) -> None:
    (warning,) = check(street()[:count])
    assert warning.text == f"{count} points, the training scans had 4000 to 5000"


def test_a_camera_view_crop_is_no_surprise_after_full_scans() -> None:
    assert check(street()[::6]) == []
