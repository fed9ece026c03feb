"""Scans unlike those of the training: each way is noticed, its remedy works, and right scans raise no alarm."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from asca_deploy import sample_scan_path
from asca_pillars.base.errors import ConfigError
from asca_pillars.geometry.boxes import Ranges
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.ops.pillar.grid import PillarGrid
from asca_pillars.scans.input_check import (
    ExpectedInput,
    InputWarning,
    _percentile,
    check_input,
    ground_z_m,
    measure_expected_input,
)
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_reader import read_scan
from asca_pillars.sim.simulation import load_simulation_config, simulate_frame

Points = NDArray[np.float32]
GRID = PillarGrid(x_range_m=(0.0, 23.04), y_range_m=(-7.68, 10.24))


def street(seed: int = 0, ground: float = -1.7, count: int = 4000) -> Points:
    """Flat ground with a wall along one side."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((0, -7.6, ground - 0.05, 0.1), (23, 10.2, ground + 0.05, 0.5), (count, 4))
    points[: count // 3, 1:3] = rng.uniform((9.5, ground), (10, ground + 3), (count // 3, 2))
    return points.astype(np.float32)


EXPECTED = measure_expected_input([street(1), street(2, ground=-1.8, count=5000)], camera_view=False)


def check(points: Points, expected: ExpectedInput = EXPECTED, mounting: Mounting | None = None) -> list[InputWarning]:
    """As the detector does it: the points are brought into the model's frame before."""
    mounting = mounting or Mounting()
    points = mounting.to_model(expected.sensor_height_m).points(points)
    return check_input(points, GRID.ranges, expected, mounting, around=True)


def test_scans_like_the_training_scans_raise_no_alarm() -> None:
    assert EXPECTED.points_per_scan == (4000, 5000)
    assert EXPECTED.reflectance_mean == pytest.approx((0.3, 0.3), abs=0.01)  # uniform in 0.1..0.5
    assert EXPECTED.ground_z_m == pytest.approx((-1.8, -1.7), abs=0.05)
    far = street(3)
    far[:100, :2] = 65_535
    for points in (street(3), street()[::6], far):  # a camera's view of a whole scan; a few points of noise
        assert check(points) == []


def test_where_the_ground_is_and_where_it_cannot_be_seen() -> None:
    points = street()
    points[:80, 2] = -9.0  # 2 % ghosts under the road
    roof = np.tile(np.array([[0.5, 0.2, -0.4, 0.3]], np.float32), (60_000, 1))
    assert ground_z_m(np.concatenate([points, roof])) == pytest.approx(-1.7, abs=0.1)
    far = street() + np.array([100, 0, 0, 0], np.float32)
    for points in (street(count=40), street()[:0], far):
        assert ground_z_m(points) is None
    expected = measure_expected_input([far, far], False)
    assert expected.ground_z_m is None and check(street(), expected) == []


@pytest.mark.parametrize(
    ("scale", "shift", "remedy"),
    [
        (1000.0, (0, 0, 0), "divide millimetres by 1000"),
        (100.0, (0, 0, 0), "centimetres by 100"),
        (1000.0, (500, -300, 0), "divide millimetres by 1000"),
        (1e36, (0, 0, 0), "coordinates have to be in metres"),
        (1.0, (0, -2000, 0), "x = 11, y = -1994: .* subtract the sensor's position"),
        (1.0, (494_428, 4_877_419, 120), "not of a map: subtract the sensor's position"),
    ],
)
def test_points_beyond_a_kilometre_are_of_another_unit_or_frame(
    scale: float, shift: tuple[int, int, int], remedy: str
) -> None:
    points = street(3).astype(np.float64)
    points[:, :3] = points[:, :3] * scale + shift
    (warning,) = check(points.astype(np.float32))
    assert warning.about == "range"
    assert re.search(remedy, warning.text) and "--axes" not in warning.text


@pytest.mark.parametrize(
    ("scale", "advice"),
    [
        (200, "divide it by 100"),
        (400, "divide it by 255 (--reflectance-scale 255"),
        (90_000, "divide it by 65535"),
        (0.003, "rescale it to 0..1"),
        (0, "no reflectance, all are 0"),
    ],
)
def test_reflectance_on_another_scale(scale: float, advice: str) -> None:
    (warning,) = check(street(5) * np.array([1, 1, 1, scale], np.float32))
    assert warning.about == "reflectance" and advice in warning.text


@pytest.mark.parametrize(
    "changes",
    [
        {"points_per_scan": (-1, 5)},
        {"points_per_scan": (6, 5)},
        {"reflectance_mean": (0.2, 1.5)},
        {"ground_z_m": (-1.0, -1.9)},
        {"ground_z_m": (-1.9, 1e308)},
    ],
)
def test_expectations_that_no_scans_have_are_refused(changes: dict[str, tuple[float, float]]) -> None:
    with pytest.raises(ConfigError, match=f"expected_input.{next(iter(changes))} = .* lowest and highest in"):
        replace(EXPECTED, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("shift_m", [-1.2, 0.9])
def test_sensor_at_another_height(shift_m: float) -> None:
    def advised(height_m: float | None) -> float:
        (warning,) = check(points, mounting=Mounting(sensor_height_m=height_m))
        assert warning.about == "height"
        return float(warning.text.split("--sensor-height ")[1].split(" ")[0])

    points = street(6, ground=-1.75) + np.array([0, 0, shift_m, 0], np.float32)
    stated = advised(None)
    assert stated == pytest.approx(1.75 - shift_m, abs=0.1)
    assert check(points, mounting=Mounting(sensor_height_m=stated)) == []  # the advice works
    assert advised(stated + 1.5) == pytest.approx(stated, abs=0.02)  # it corrects a wrong height, too


def test_nothing_on_the_grid_and_wrong_axes_that_were_given() -> None:
    warning = check(revolution() + np.array([100, 0, 0, 0], np.float32))[-1]
    assert warning.about == "range"
    assert warning.text.startswith("100.0 % of the points lie outside the grid") and "--axes" in warning.text
    (warning,) = check(revolution(), mounting=Mounting(axes="y-forward"))
    assert "check the axes" in warning.text


def revolution(seed: int = 0, ground: float = -1.75) -> Points:
    """A street all around: ground 40 m ahead and behind, walls 9 m to the left and right."""
    rng = np.random.default_rng(seed)
    low, high = (-40, -9, ground - 0.03, 0.1), (40, 9, ground + 0.03, 0.5)
    points = rng.uniform(low, high, (12_000, 4))
    points[:3000, 1] = rng.choice([-9, 9], 3000)
    points[:3000, 2] = rng.uniform(ground, ground + 4, 3000)
    return points.astype(np.float32)


@pytest.mark.parametrize("angle_deg", [-20, -5, 0, 5, 20])
def test_a_right_scan_all_around(angle_deg: float) -> None:
    vehicle_in_street = FrameChange.turn(np.radians(angle_deg))
    assert check(vehicle_in_street.points(revolution())) == []


@pytest.mark.parametrize("axes", ["y-forward", "x,-y,-z"])
@pytest.mark.parametrize("scan", [revolution(1), read_scan(sample_scan_path()).points], ids=["street", "sample"])
def test_other_axes_are_noticed_and_the_remedy_corrects_them(scan: Points, axes: str) -> None:
    wrong = Mounting(axes=axes).level.inverse.points(scan)
    (warning,) = check(wrong)
    remedy = warning.text.split("(--axes ")[1].split(")")[0]
    assert remedy == axes
    assert check(wrong, mounting=Mounting(axes=remedy)) == []


@pytest.mark.parametrize("axes", ["y,-x,z", "-x,-y,z", "-y,x,z"])
def test_a_sector_that_is_not_ahead(axes: str) -> None:
    points = revolution(2)
    ahead = points[points[:, 0] > np.abs(points[:, 1])]
    wrong = Mounting(axes=axes).level.inverse.points(ahead)
    warnings = {warning.about: warning.text for warning in check(wrong)}
    assert f"(--axes {axes})" in warnings["axes"]
    assert check(wrong, mounting=Mounting(axes=axes)) == []


def test_sectors_that_are_not_ahead_and_tilted_sensors() -> None:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", -12, degrees=True).as_matrix()
    points = FrameChange(pose[:3, :3].T, np.zeros(3)).points(revolution())
    (warning,) = check(points)
    assert warning.about == "tilt" and "--pose" in warning.text
    assert check(points, mounting=Mounting(pose=pose)) == []  # type: ignore[arg-type]
    points = revolution()
    roof = np.tile(np.array([[-1.5, 0.3, -0.6, 0.2]], np.float32), (9000, 1))
    assert not told_to_look_around(np.concatenate([roof, points[points[:, 0] > 0]]))
    assert not told_to_look_around(points[points[:, 0] > np.abs(points[:, 1])], axes="-x,-y,z")


@pytest.mark.parametrize("count", [0, 1, 399])
def test_too_few_points(count: int) -> None:
    (warning,) = check(street()[:count])
    assert warning.text == f"{count} points, the training scans had 4000 to 5000"


AHEAD = Ranges((0.0, 69.12), (-30.72, 30.72), (-3.0, 1.0))


def told_to_look_around(points: Points, model_ranges: Ranges | None = AHEAD, axes: str = "x-forward") -> bool:
    points = Mounting(axes=axes).level.inverse.points(points)
    warnings = check_input(points, model_ranges or GRID.ranges, EXPECTED, around=model_ranges is None)
    texts = {warning.about: warning.text for warning in warnings}
    assert "view" not in texts or "(--around)" in texts["view"]
    return "view" in texts


@pytest.mark.parametrize("sensor", ["hdl_32e", "os1_64", "os1_128", "vlp_16", "vlp_32c_pair", "residential"])
def test_a_revolution_is_said_to_be_cut(sensor: str) -> None:
    """A scan has half of its points behind the sensor, and a model that looks ahead leaves them out."""
    for number in range(1):
        points = simulate_frame(5, number, load_simulation_config(sensor, "full")).points
        assert told_to_look_around(points)
        assert told_to_look_around(points, axes="y-forward"), "whatever else is wrong"
        assert not told_to_look_around(points, None), "it looks around"
        assert not told_to_look_around(points, Ranges((-69.12, 69.12), *AHEAD[1:])), "so does this model, in one pass"
        assert not told_to_look_around(points, Ranges((5.0, 69.12), (2.0, 30.0), (-3.0, 1.0))), "this one cannot"
        angles = np.abs(np.arctan2(points[:, 1], points[:, 0]))
        for field_deg in (70, 120, 180, 270):
            assert told_to_look_around(points[angles < np.radians(field_deg / 2)]) == (field_deg == 270)


@given(
    st.lists(st.floats(-100, 100, width=32), min_size=1, max_size=30),
    st.sampled_from([0.0, 5.0, 10.0, 50.0, 80.0, 100.0]),
)
def test_percentiles_are_numpys(values: list[float], percent: float) -> None:
    found = _percentile(np.sort(np.array(values, np.float32)), percent)
    assert found == pytest.approx(np.percentile(np.array(values), percent), abs=1e-9)
