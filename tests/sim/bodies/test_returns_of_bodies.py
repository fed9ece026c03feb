"""Bodies return as many points, from the same heights and as brightly, as KITTI's objects do.

Each bound lies between what KITTI's objects show beside simulated ones at like distance, view and occlusion and what
thinner bodies with a lidar's ray of no width would.
"""

import numpy as np
import pytest

from asca_pillars.evaluation.errors.label_fit import label_fit
from asca_pillars.sim.bodies.people import SHARES, bicycle, cyclist_body, draw_burden, pedestrian_body
from asca_pillars.sim.bodies.styles import draw_style
from asca_pillars.sim.bodies.vehicles import car_body
from asca_pillars.sim.report.scan_statistics import (
    COLUMNS,
    DOOR_ZEROS,
    UPPER_ZEROS,
    WINDOW_RETURNS,
    window_returns,
    zero_shares,
)
from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.world.placement import Target
from asca_pillars.sim.world.scene import BEAM_M_PER_M, body_of
from tests.sim.bodies.single_body import view

SEEDS = range(24)
BRIGHT = 0.5


def cyclists(distance_m: float, yaw_rad: float) -> list[np.ndarray]:
    footprint_m = BEAM_M_PER_M * distance_m
    bodies = [cyclist_body(np.random.default_rng(seed), 1.66, 0.6, 1.72, footprint_m) for seed in SEEDS]
    return [view(body, distance_m, yaw_rad, seed) for seed, body in zip(SEEDS, bodies, strict=True)]


def pedestrians(distance_m: float, yaw_rad: float) -> list[np.ndarray]:
    return [view(pedestrian_body(np.random.default_rng(s), 1.7, 0.66, 0.85), distance_m, yaw_rad, s) for s in SEEDS]


def cars(distance_m: float) -> list[np.ndarray]:
    seen = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        body = car_body(rng, 4.0, 1.65, 1.5, draw_style(rng, 4.0, 1.5), 0.42, BEAM_M_PER_M * distance_m)
        seen.append(view(body, distance_m, 0.1 + 0.03 * seed, seed))
    return seen


def test_cyclists_return_from_wheels_and_frame_and_brightly_from_afar() -> None:
    """At 20 m across the line of sight: 1.6 times 92 points, 2.5 times 26 of them from 12 to 30 % of the height."""
    seen = cyclists(20.0, np.pi / 2)
    wheels = [((points[:, 2] > 0.20) & (points[:, 2] < 0.52)).sum() for points in seen]
    assert 125 < np.mean([len(points) for points in seen]) < 190
    assert 40 < np.mean(wheels) < 75
    assert np.mean([np.ptp(points[:, 0]) for points in seen]) > 1.5
    # Reflectors, tires and jackets: 12 % of the returns at 30 m, where cloth reports hardly any.
    share = np.mean([(points[:, 3] >= BRIGHT).mean() for points in cyclists(30.0, np.pi / 2)])
    assert 0.05 < share < 0.18


def test_pedestrians_are_as_broad_and_step_as_wide_as_real_ones() -> None:
    """At 20 m from the side: 1.4 times 66 points over 0.69 m instead of 0.53 m."""
    seen = pedestrians(20.0, np.pi / 2)
    assert 80 < np.mean([len(points) for points in seen]) < 110
    assert 0.62 < np.mean([np.ptp(points[:, 0]) for points in seen]) < 0.82


def test_cars_shine_have_low_windows_and_end_where_those_of_kitti_do() -> None:
    seen = cars(18.0)
    bright = np.mean([(points[:, 3] >= BRIGHT).mean() for points in seen])
    middle = np.mean([((points[:, 2] > 0.75) & (points[:, 2] < 1.05)).mean() for points in seen])
    assert 0.075 < bright < 0.16
    assert middle < 0.255
    assert 0.4 < np.mean([(points[:, 3] == 0).mean() for points in seen]) < 0.75
    # Flanks 0.07 to 0.57 m before the label's far face, last upper points (mirrors) at 0.5 to 0.7 of the length.
    fits = dict(zip(COLUMNS, label_fits(0.2, 12.0).T, strict=True))
    assert -0.42 < np.nanmedian(fits["flank_end"]) < -0.08
    assert 0.5 < np.nanmedian(fits["upper_end"]) < 0.72
    assert 1.3 < np.nanmedian(fits["roof_end"]) < 2.1, "a rail runs along the roof above the windows"
    assert -0.14 < np.nanmedian(fits["nearest_point"]) < 0.02
    assert -0.18 < np.nanmedian(fits["rear_width"]) < -0.03
    assert -0.13 < np.nanmedian(fits["top_97"]) < -0.04
    assert np.nanmean(fits["low_inside"]) < 0.15
    # KITTI's by drive: 0.55 to 0.95.
    windows = label_fits(0.7, 14.0)[:, COLUMNS.index(WINDOW_RETURNS)]
    assert 0.35 < np.nanmedian(windows) < 1.1


@pytest.mark.parametrize("yaw_rad", [0.2, 0.8, 1.5])
def test_windows_and_their_frames_are_too_dark_for_a_report_and_doors_less_often(yaw_rad: float) -> None:
    """KITTI's medians by drive: 0.82 to 1.0 above the doors, 0.2 to 0.7 on them."""
    fits = dict(zip(COLUMNS, label_fits(yaw_rad, 20.0).T, strict=True))
    assert np.nanmedian(fits[UPPER_ZEROS]) > 0.72
    assert 0.15 < np.nanmean(fits[DOOR_ZEROS]) < 0.6


def label_fits(yaw_rad: float, distance_m: float) -> np.ndarray:
    """Statistics (24, columns) of cars 1.5 m left of straight ahead, as their labels would have them."""
    rows = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        target = Target("Car", np.array([distance_m, 1.5, 0.75, 3.9, 1.63, 1.5, 0.0]))
        body = body_of(target, SceneConfig(), rng).placed(-distance_m, -1.5, 0.0, 0.0)
        seen = view(body, distance_m, yaw_rad, seed)
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        x, y = seen[:, 0] * cos - seen[:, 1] * sin + distance_m, seen[:, 0] * sin + seen[:, 1] * cos
        box = np.array([distance_m, 0.0, 0.75, 3.9, 1.63, 1.5, yaw_rad])
        points = np.column_stack([x, y, seen[:, 2:]])
        rows.append([*label_fit(points, box[None])[0], window_returns(points, box), *zero_shares(points, box)])
    return np.array(rows)


def test_people_stand_behind_the_middle_of_their_labels_and_carry_things() -> None:
    """Annotators center a box on what they see: KITTI's 5 % and median of range are 0.2 and 0.09 m before it."""
    rows = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        box = np.array([15.0, 0.0, 0.85, 0.85, 0.66, 1.7, float(rng.uniform(-3.1, 3.1))])
        body = body_of(Target("Pedestrian", box), SceneConfig(), rng).placed(-15.0, 0.0, 0.0, 0.0)
        points = view(body, 15.0, 0.0, seed)[:, :3] + (15.0, 0.0, 0.0)
        rows.append(label_fit(points, box[None])[0])
    fits = dict(zip(COLUMNS, np.array(rows).T, strict=False))
    assert -0.27 < np.nanmedian(fits["range_5"]) < -0.12
    assert -0.12 < np.nanmedian(fits["range_50"]) < 0.0
    assert 0.45 < np.nanmedian(fits["range_spread"]) < 0.8
    rng = np.random.default_rng(0)
    bodies = [draw_burden(rng, 1.7, 0.02, 0.24) for _ in range(600)]
    with_something = np.mean([len(body.triangles) + len(body.centers) > 0 for body in bodies])
    assert with_something == pytest.approx(sum(SHARES.values()), abs=0.05)
    widest = [np.abs(body.triangles[..., 1]).max(initial=0.0) for body in bodies]
    assert np.mean(np.array(widest) > 0.42) == pytest.approx(SHARES["bicycle"], abs=0.03)


@pytest.mark.parametrize("length", [1.45, 1.7, 2.1])
def test_a_bicycle_stands_on_its_wheels_and_is_as_long_as_asked_for(length: float) -> None:
    for seed in range(6):
        corners = bicycle(np.random.default_rng(seed), length).triangles.reshape(-1, 3)
        assert corners[:, 2].min() == pytest.approx(0.0, abs=0.02)
        assert np.ptp(corners[:, 0]) == pytest.approx(length, abs=0.08)
