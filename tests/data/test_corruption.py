"""Corruption changes the points of objects only, within what was asked for, and nothing when it is off."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_pillars.config.tree import AugmentConfig
from asca_pillars.data.augment import FEWEST_POINTS, corrupt_objects, drop_reflectance
from asca_pillars.geometry.boxes import points_in_boxes
from tests.helpers.scenes import make_scene

POINTS, BOXES, _ = make_scene(3)
INSIDE = points_in_boxes(POINTS, BOXES)


def config(**changes: object) -> AugmentConfig:
    return dataclasses.replace(AugmentConfig(), **changes)  # type: ignore[arg-type]


def corrupted(seed: int, points: NDArray[np.float32] = POINTS, **changes: object) -> NDArray[np.float32]:
    return corrupt_objects(points, BOXES, config(**changes), np.random.default_rng(seed))


def test_off_draws_nothing() -> None:
    rng = np.random.default_rng(0)
    assert corrupt_objects(POINTS, BOXES, AugmentConfig(), rng) is POINTS
    points = POINTS.copy()
    drop_reflectance(points, AugmentConfig(), rng)
    assert np.array_equal(points, POINTS)
    assert rng.bit_generator.state == np.random.default_rng(0).bit_generator.state


def test_each_object_has_one_gain_of_its_own() -> None:
    before = POINTS.copy()
    found = corrupted(1, object_reflectance_gain=(0.5, 2.0))
    assert np.array_equal(POINTS, before) and np.array_equal(found[:, :3], POINTS[:, :3])
    assert np.array_equal(found[~INSIDE.any(axis=1)], POINTS[~INSIDE.any(axis=1)])
    gains = []
    for own in INSIDE.T:
        dark = own & (POINTS[:, 3] < 0.45)  # twice as much is not cut off at 1
        ratio = found[dark, 3] / POINTS[dark, 3]
        assert np.ptp(ratio) < 1e-5 and 0.5 <= ratio[0] <= 2
        gains.append(ratio[0])
    assert len(set(np.round(gains, 4))) == len(BOXES) and found[:, 3].max() <= 1


def test_gains_halve_as_often_as_they_double() -> None:
    dark = POINTS.copy()
    dark[:, 3] = 0.1
    gains = [corrupted(s, dark, object_reflectance_gain=(0.5, 2.0))[INSIDE[:, 0], 3][0] / 0.1 for s in range(300)]
    assert np.mean(np.array(gains) > 1) == pytest.approx(0.5, abs=0.1)


def test_jitter_has_its_standard_deviation() -> None:
    found = corrupted(2, object_jitter_m=0.015)
    moved = INSIDE.any(axis=1)
    assert np.array_equal(found[~moved], POINTS[~moved]) and np.array_equal(found[:, 3], POINTS[:, 3])
    difference = (found - POINTS)[moved, :3]
    assert difference.std() == pytest.approx(0.015, rel=0.1) and abs(difference.mean()) < 0.002


def test_a_cut_takes_a_sector_or_rings_as_seen_from_the_sensor() -> None:
    taken = {"azimuth": 0, "elevation": 0}
    for seed in range(40):
        found = corrupted(seed, object_cut_probability=1.0)
        gone = ~np.isin(POINTS.view("V16").ravel(), np.ascontiguousarray(found).view("V16").ravel())
        assert not gone[~INSIDE.any(axis=1)].any()
        for own in INSIDE.T:
            if not gone[own].any():
                continue
            x, y, z, _ = POINTS[own].astype(np.float64).T
            angles = {"azimuth": np.arctan2(y, x), "elevation": np.arctan2(z, np.hypot(x, y))}
            cut = gone[own]
            assert (~cut).sum() >= FEWEST_POINTS
            # Nothing that stays lies inside the range of what is gone, in one of the two angles.
            clean = {
                name: not ((angle > angle[cut].min()) & (angle < angle[cut].max()))[~cut].any()
                for name, angle in angles.items()
            }
            assert any(clean.values())
            for name in taken:
                taken[name] += clean[name]
    assert min(taken.values()) > 20


def test_an_object_of_few_points_is_not_cut() -> None:
    few = np.concatenate([POINTS[INSIDE[:, 0]][:FEWEST_POINTS], POINTS[~INSIDE.any(axis=1)]])
    for seed in range(20):
        assert len(corrupted(seed, few, object_cut_probability=1.0)) == len(few)
    nothing = corrupted(0, np.empty((0, 4), np.float32), object_cut_probability=1.0, object_jitter_m=0.1)
    assert nothing.shape == (0, 4)


def test_reflectance_is_lost_in_part_or_is_one_value() -> None:
    some = constant = same = 0
    bright = POINTS.copy()
    bright[:, 3] = np.linspace(0.2, 0.9, len(bright))
    for seed in range(200):
        points = bright.copy()
        drop_reflectance(points, config(reflectance_loss_probability=0.5), np.random.default_rng(seed))
        assert np.array_equal(points[:, :3], bright[:, :3])
        same += np.array_equal(points, bright)
        constant += np.ptp(points[:, 3]) == 0
        some += bool((points[:, 3] == 0).any() and np.isin(points[:, 3], [0, *bright[:, 3]]).all())
    assert same == pytest.approx(100, abs=25) and constant == pytest.approx(50, abs=20)
    assert some == pytest.approx(50, abs=20)


def test_a_cut_is_that_of_the_sensor_wherever_the_origin_is() -> None:
    """Points of a vehicle's frame, whose sensor stands on its roof, lose what those of the sensor's own frame lose."""
    cut, sensor_m = config(object_cut_probability=1.0), (1.5, 0.25, 2.0)
    boxes = BOXES + np.array([0, 0, 0, 0.02, 0.02, 0.02, 0], np.float32)  # no point on a face
    lifted = POINTS + np.array([*sensor_m, 0], np.float32), boxes + np.array([*sensor_m, 0, 0, 0, 0], np.float32)
    for seed in range(6):
        own = corrupt_objects(POINTS, boxes, cut, np.random.default_rng(seed))
        found = corrupt_objects(*lifted, cut, np.random.default_rng(seed), sensor_m)
        from_the_origin = corrupt_objects(*lifted, cut, np.random.default_rng(seed))
        assert abs(len(found) - len(own)) <= 1 < abs(len(from_the_origin) - len(own))
