"""KITTI's HDL-64E and the sensors that ship as configurations."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.schema import parse
from asca_pillars.sim.bodies.primitives import Surface, quads
from asca_pillars.sim.casting.raycast import Bodies, cast
from asca_pillars.sim.lidar import Lidar, draw_firings
from asca_pillars.sim.returns import Returns, measure
from asca_pillars.sim.simulation import SimulationConfig, simulate_frame
from asca_pillars.sim.world.ground import Ground, make_street

FOLDER = Path(__file__).parents[2] / "configs/simulation"
# Rings, highest and lowest elevation, firings per revolution: from the data sheets, not from our files.
SHEETS = {
    "hdl_32e": (32, 10.67, -30.67, 2170),
    "vlp_16": (16, 15.0, -15.0, 1808),
    "os1_64": (64, 16.6, -16.6, 1024),
    "os1_128": (128, 22.5, -22.5, 1024),
}


def preset(name: str) -> SimulationConfig:
    text = (FOLDER / f"{name}.yaml").read_text(encoding="utf-8")
    return parse(SimulationConfig, yaml.safe_load(text), name)


def flat_scan(lidar: Lidar, seed: int = 0) -> Returns:
    """A bright wall around the sensor, 12 m away, on flat ground: every laser meets something everywhere."""
    angle = np.linspace(0, 2 * np.pi, 361)
    a, b = angle[:-1], angle[1:]
    ring = [[np.cos(x), np.sin(x)] for x in (a, b)]
    low, high = np.full(360, -9.0), np.full(360, 9.0)
    corners = [
        np.stack([12 * xy[0], 12 * xy[1], z], 1)
        for xy, z in zip([*ring, *ring[::-1]], (low, low, high, high), strict=True)
    ]
    wall = quads(np.stack(corners, 1), Surface(0.5, 0.0))
    none = np.zeros(0, int)
    owner = np.full(len(wall.triangles), -1)
    firings = draw_firings(lidar, np.random.default_rng(seed), camera_only=False)
    ground = Ground(make_street(half_width_m=200.0), np.zeros((49, 49)), np.full(8, 0.4), -1.73)
    hits = cast(Bodies(wall, owner, np.arange(len(owner)), none, none), 0, ground, firings, seed=0)
    return measure(hits, firings, np.random.default_rng(seed))


@pytest.mark.parametrize("name", SHEETS)
def test_a_sensor_is_what_its_data_sheet_says(name: str) -> None:
    rings, top, bottom, per_turn = SHEETS[name]
    lidar = preset(name).lidar
    scan = flat_scan(lidar)
    x, y, z, _ = scan.points.astype(float).T
    assert set(scan.ring) == set(range(rings))
    # All lasers leave one point, so the elevation of a ring is that of its points.
    elevation = np.rad2deg(np.arctan2(z, np.hypot(x, y)))
    measured = np.array([np.median(elevation[scan.ring == ring]) for ring in range(rings)])
    np.testing.assert_allclose(measured, lidar.elevation_deg, atol=4 * lidar.elevation_jitter_deg)
    assert (measured[0], measured[-1]) == pytest.approx((top, bottom), abs=0.15)
    for ring in (0, rings // 2, rings - 1):
        here = scan.ring == ring
        azimuth = np.sort(np.rad2deg(np.arctan2(y[here], x[here])) % 360)
        assert len(azimuth) == pytest.approx(per_turn, rel=0.02)
        assert np.median(np.diff(azimuth)) == pytest.approx(360 / per_turn, rel=0.02)
        # The own car hides nothing, not even from the lowest laser.
        assert np.diff(azimuth).max() < 12 * 360 / per_turn


@pytest.mark.parametrize("name", SHEETS)
def test_a_street_is_scanned_within_the_sensor_s_range(name: str) -> None:
    config = preset(name)
    frame = simulate_frame(2, 0, config)
    distance = np.linalg.norm(frame.points[:, :3], axis=1)
    near, far = config.lidar.range_m
    assert near <= distance.min() and distance.max() < far
    assert 0.4 * SHEETS[name][0] * SHEETS[name][3] < len(distance)


def test_two_stacked_sensors_are_one_list_of_lasers() -> None:
    """An upright VLP-32C and one upside down below it: each laser leaves its own sensor."""
    config = preset("vlp_32c_pair")
    scan = flat_scan(config.lidar)
    firings = draw_firings(config.lidar, np.random.default_rng(0), camera_only=False)
    assert firings.hidden.shape == (64, 1808) and set(firings.origin_z_m) == {0.0, -0.115}
    rho = np.hypot(scan.points[:, 0], scan.points[:, 1]).astype(float)
    elevation = np.rad2deg(np.arctan2(scan.points[:, 2] - firings.origin_z_m[scan.ring], rho))
    measured = np.array([np.median(elevation[scan.ring == ring]) for ring in range(64)])
    upper = firings.origin_z_m == 0.0
    np.testing.assert_allclose(measured[upper], -measured[~upper][::-1], atol=0.05)
    assert (measured[upper].max(), measured[upper].min()) == pytest.approx((15.0, -25.0), abs=0.1)


def test_lasers_take_their_origin_along_and_kitti_s_sensor_has_its_pattern() -> None:
    """Two lasers have almost the same elevation, and in some scans the lower one is adjusted above the other."""
    lidar = Lidar(
        elevation_deg=(0.01, 0.0), origin_z_m=((0.0, 0.0), (-1.0, -1.0)), elevation_jitter_deg=1.0, ring_gain=()
    )
    drawn = [draw_firings(lidar, np.random.default_rng(seed), camera_only=True) for seed in range(20)]
    assert all((np.diff(firings.slope) < 0).all() for firings in drawn)
    assert {tuple(firings.origin_z_m) for firings in drawn} == {(0.0, -1.0), (-1.0, 0.0)}
    firings = draw_firings(Lidar(), np.random.default_rng(1), camera_only=False)
    step = np.rad2deg(np.diff(firings.azimuth_rad))
    assert np.isclose(step, 0.09).mean() == pytest.approx(0.1428, abs=0.002)
    assert (np.isclose(step, 0.09) | np.isclose(step, 0.18)).all()
    assert len(firings.azimuth_rad) == pytest.approx(2153.8, abs=1)
    ahead, left = np.argmin(np.abs(firings.azimuth_rad - 0.05)), np.argmin(np.abs(firings.azimuth_rad - 1.5))
    assert firings.hidden[63, ahead] and not firings.hidden[50, ahead] and not firings.hidden[:, left].any()
    # Two blocks of lasers, 8 cm apart where one ends and the other begins.
    assert firings.origin_z_m[31] - firings.origin_z_m[32] == pytest.approx(0.072, abs=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"elevation_deg": [-1.0, 1.0]}, "from the top"),
        ({"origin_z_m": [[0, 0], [0, 0], [0, 0]]}, "3 blocks"),
        ({"azimuth_steps": []}, "azimuth_steps"),
        ({"azimuth_counts": 9000}, "4096 firings"),
        ({"azimuth_counts": 10**400}, "4096 firings"),
        ({"ring_gain": [1.0]}, "1 values for 64"),
        ({"ego_first_ring": []}, "ego_first_ring has 0 values, ego_beyond_ring 120"),
        ({"range_m": [9.0, 3.0]}, "lower bound"),
        ({"zero_power": [0, 5e-5]}, "zero_power is .*: must be positive"),
        ({"ring_bias_sigma_m": -0.1}, "ring_bias_sigma_m is -0.1: must not be negative"),
    ],
)
def test_impossible_sensors_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse(SimulationConfig, {"lidar": change}, "sensor.yaml")
