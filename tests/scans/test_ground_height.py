"""The height of the ground near the sensor, whatever else the scan holds.

The plane that most points lie on, against planes that are known.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.ground_height import (
    BAND_M,
    NamedPoints,
    _least_squares,
    estimate_height,
    estimate_named_height,
    fit_ground_plane,
    measured_mounting,
    most_common_plane,
    plane_heights,
)
from asca_pillars.scans.mounting import Mounting


def sloped(height: float, tilt_deg: float = 0.0, seed: int = 0, noise_m: float = 0.02) -> NDArray[np.float32]:
    """Ground all around, so far below the sensor, with walls on both sides and a few cars."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-25, -12, 0, 0.1), (25, 12, 0, 0.5), (20_000, 4))
    points[:, 2] = np.tan(np.radians(tilt_deg)) * points[:, 0] - height + rng.normal(0, noise_m, len(points))
    points[:5000, 1] = rng.choice([-12, 12], 5000)
    points[:5000, 2] += rng.uniform(0, 5, 5000)
    points[5000:6000, :3] = rng.uniform((5, 2, -height + 0.3), (9, 4, -height + 1.5), (1000, 3))
    return points.astype(np.float32)


@pytest.mark.parametrize("height", [0.0, 0.4, 1.73, 3.2])
def test_the_height_is_estimated(height: float) -> None:
    estimate = estimate_height([sloped(height, seed=seed) for seed in range(3)])
    assert estimate.height_m == pytest.approx(height, abs=0.03)
    assert estimate.spread_m < 0.05 and estimate.share > 0.8 and estimate.scans == 3
    assert f"{estimate.height_m:.2f} m" in str(estimate)


@pytest.mark.parametrize(("deeper_m", "below"), [(1.5 * BAND_M, False), (3 * BAND_M, True)])
def test_ruts_are_not_below_the_ground(deeper_m: float, below: bool) -> None:
    """A quarter of the ground is lower; beyond twice the band it tells of a plane above the ground."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-20, -20, -1.71), (20, 20, -1.69), (30_000, 3))
    points[(points[:, 0] % 4 < 1), 2] -= deeper_m
    plane = fit_ground_plane(points)
    assert plane is not None and plane.height_m == pytest.approx(1.7, abs=0.02)
    assert plane.share == pytest.approx(0.75, abs=0.02)
    assert plane.share_below == pytest.approx(0.25 if below else 0.0, abs=0.02)


def test_heights_go_along_the_axes_and_points_on_a_line_are_no_ground() -> None:
    line = np.linspace((-16, -11.7, -1.7), (16, 11.9, -1.7), 4000)
    assert fit_ground_plane(line) is None
    with pytest.raises(ScanError, match="too few points near the sensor, or all on one line"):
        estimate_height([line])
    points = sloped(1.2)
    points[:, 1:3] *= -1
    mounting, estimate = measured_mounting([points], Mounting(axes="x,-y,-z"))
    assert mounting == Mounting(sensor_height_m=estimate.height_m, axes="x,-y,-z")
    assert estimate.height_m == pytest.approx(1.2, abs=0.03)
    scans = iter([NamedPoints(str(number), sloped(1.7, seed=number)) for number in range(4)])
    assert estimate_named_height(scans, enough=2).scans == 2
    assert next(scans).name == "2"


@pytest.mark.parametrize(
    ("scans", "message"),
    [
        ([], "without a scan"),
        ([sloped(1.7), sloped(1.2)], r"2 scans disagree by 0\.50 m .*: 1\.2. m in scan 2, 1\.7. m in scan 1;"),
        ([sloped(1.7)[:100], sloped(1.7, tilt_deg=9)], r"from scan 1: too few points .* \(and 1 more\)"),
    ],
)
def test_an_unsure_height_is_refused(scans: list[NDArray[np.float32]], message: str) -> None:
    with pytest.raises(ScanError, match=f"{message}.*--sensor-height"):
        estimate_height(scans)


@pytest.mark.parametrize(
    ("garage", "why"),
    [
        (sloped(1.7)[:100], "too few points"),
        (sloped(1.7, tilt_deg=9), "tilted by 9 degrees"),
        (sloped(1.7, noise_m=2.0), "of the low points"),
    ],
)
def test_a_scan_without_ground_is_left_out_and_named(garage: NDArray[np.float32], why: str) -> None:
    with pytest.raises(ScanError, match=f"from scan 1: .*{why}"):
        estimate_height([garage])
    for place in range(3):
        scans = [NamedPoints(f"{number}.bin", sloped(1.7, seed=number)) for number in range(2)]
        scans.insert(place, NamedPoints("garage.bin", garage))
        estimate = estimate_named_height(scans)
        assert estimate.height_m == pytest.approx(1.7, abs=0.03) and estimate.scans == 2
        (left_out,) = estimate.left_out
        assert left_out.startswith("garage.bin: ") and why in left_out
        assert f"from 2 scans, which agree within {estimate.spread_m:.2f} m" in str(estimate)
        assert str(estimate).endswith(f"; left out: {left_out}")
        assert estimate_height([points for _, points in scans]).left_out[0].startswith(f"scan {place + 1}: ")


SLOPES = st.floats(-0.25, 0.25)


def on_plane(rng: np.random.Generator, plane: tuple[float, float, float], count: int) -> np.ndarray:
    xy = rng.uniform((0, -30), (40, 30), (count, 2))
    return np.column_stack([xy, xy @ plane[:2] + plane[2] + rng.normal(0, 0.02, count)])


@settings(max_examples=50, deadline=None)
@given(SLOPES, SLOPES, st.floats(-3, 1), st.floats(0.1, 0.6), st.integers(0, 99))
def test_a_plane_is_found_among_walls_and_outliers(a: float, b: float, c: float, clutter: float, seed: int) -> None:
    """Up to six tenths of the points are no ground: half of these on two walls, half anywhere above."""
    rng = np.random.default_rng(seed)
    points = on_plane(rng, (a, b, c), 1000)
    wall, high = np.array_split(rng.permutation(1000)[: int(1000 * clutter)], 2)
    points[wall, 1] = rng.choice([-12.0, 15.0], len(wall))
    points[wall, 2] = points[wall, :2] @ (a, b) + c + rng.uniform(0, 4, len(wall))
    points[high, 2] += rng.uniform(0.3, 6, len(high))
    found = most_common_plane(points, 0.15, max_slope=0.3)
    assert found is not None
    error = np.column_stack([points[:, :2], np.ones(1000)]) @ (found - (a, b, c))
    assert np.abs(error).max() < 0.08


def test_of_two_levels_the_one_with_more_points_each_time() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([on_plane(rng, (0, 0, -1.7), 600), on_plane(rng, (0, 0, 1.0), 400)])
    found = most_common_plane(points, 0.1)
    assert found is not None and found == pytest.approx((0, 0, -1.7), abs=0.01)
    assert np.array_equal(found, np.array(most_common_plane(points.copy(), 0.1)))


def test_points_without_a_plane_and_points_in_a_line() -> None:
    line = np.linspace((0, 0, -1.7), (30, 30, -1.5), 100)
    steep = on_plane(np.random.default_rng(0), (0.5, 0, -5), 100)
    assert most_common_plane(np.zeros((0, 3)), 0.1) is None
    assert most_common_plane(line, 0.1) is None
    assert most_common_plane(steep, 0.1, max_slope=0.3) is None
    assert most_common_plane(steep, 0.1) == pytest.approx((0.5, 0, -5), abs=0.02)
    assert _least_squares(*np.linspace((0, 0, 1), (3, 5, 2), 9).T) is None
    assert _least_squares(*np.zeros((3, 2))) is None


@given(SLOPES, SLOPES, st.floats(-3, 1), st.integers(3, 60))
def test_the_plane_of_least_squares_is_numpys(a: float, b: float, c: float, count: int) -> None:
    points = on_plane(np.random.default_rng(count), (a, b, c), count)
    design = np.column_stack([points[:, :2], np.ones(count)])
    expected = np.linalg.lstsq(design, points[:, 2], rcond=None)[0]
    found = _least_squares(*points.T)
    assert found is not None
    np.testing.assert_allclose(found, expected, atol=1e-8)
    np.testing.assert_allclose(plane_heights(found, points), design @ expected, atol=1e-8)
