"""Which points the report takes for ground."""

import numpy as np
import pytest

from asca_pillars.sim.report.scan_statistics import ground_mask, most_common_ground
from tests.sim.report.made_up import GROUND_Z_M, rings


@pytest.mark.parametrize("slope", [0.0, 0.05, -0.05])
def test_the_ground_of_a_made_up_scan_is_found(slope: float) -> None:
    points, truth = rings(np.random.default_rng(0), slope)
    found = ground_mask(points)
    assert np.mean(found == truth) > 0.97
    plane = most_common_ground(points[truth])
    assert plane is not None
    np.testing.assert_allclose(plane, [slope, 0, GROUND_Z_M], atol=1e-3)


def test_a_hill_is_followed_and_neither_a_roof_nor_a_wall_is_ground() -> None:
    rng = np.random.default_rng(0)
    radius, angle = 70 * np.sqrt(rng.random(60_000)), rng.uniform(-np.pi, np.pi, 60_000)
    z = GROUND_Z_M + 0.06 * np.maximum(radius - 20, 0)  # three metres up at 70 m
    on_roof = (np.abs(angle) < 0.2) & (radius > 30) & (radius < 40)
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.where(on_roof, z + 2.5, z)])
    found = ground_mask(points)
    assert found[~on_roof].mean() > 0.95
    assert not found[on_roof].any()
    rng = np.random.default_rng(0)
    assert ground_mask(np.zeros((0, 4), np.float32)).shape == (0,)
    assert not ground_mask(rng.random((50, 4))).any()
    wall = np.column_stack([np.full(3000, 10.0), rng.uniform(-9, 9, 3000), rng.uniform(-2, 3, 3000)])
    assert ground_mask(wall).mean() < 0.2
