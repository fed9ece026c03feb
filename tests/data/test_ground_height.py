"""The height of the ground near the sensor, whatever else the scan holds."""

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_pillars.data.expected_input import ground_z_m


def street(count: int = 4000) -> NDArray[np.float32]:
    """Flat ground at z = -1.7 with a wall along one side."""
    rng = np.random.default_rng(4)
    points = rng.uniform((0, -7.6, -1.75, 0.1), (23, 10.2, -1.65, 0.5), (count, 4))
    points[: count // 3, 1:3] = rng.uniform((9.5, -1.7), (10, 1.3), (count // 3, 2))
    return points.astype(np.float32)


def test_the_ground_is_not_a_reflection_below_it_nor_the_vehicles_roof() -> None:
    points = street()
    points[:80, 2] = -9.0  # 2 % ghosts under the road
    roof = np.tile(np.array([[0.5, 0.2, -0.4, 0.3]], np.float32), (60_000, 1))
    assert ground_z_m(np.concatenate([points, roof])) == pytest.approx(-1.7, abs=0.1)


def test_too_few_points_near_the_sensor() -> None:
    assert ground_z_m(street(40)) is None
    assert ground_z_m(street()[:0]) is None
    assert ground_z_m(street() + np.array([100, 0, 0, 0], np.float32)) is None
