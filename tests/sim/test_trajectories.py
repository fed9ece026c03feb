"""Ways of a sequence: nobody meets anybody, and what moves does so at a constant speed."""

import numpy as np
import pytest
import shapely

from asca_pillars.sim.moving_scene import (
    EGO_M,
    FAR_M,
    RING_M,
    TRAVEL_M,
    Trajectory,
    draw_moving_scene,
    held_footprints,
)
from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.world.placement import ON_FOOT
from tests.geometry.overlap_oracles import polygon


def scene(seed: int, duration_s: float = 8.0):
    rng, ways = np.random.default_rng([seed, 0]), np.random.default_rng([seed, 1])
    return draw_moving_scene(SceneConfig(cars=14, pedestrians=8, cyclists=6), rng, ways, duration_s)


def test_ways_stop_at_their_ends_and_traffic_comes_back_as_somebody_else() -> None:
    places = Trajectory(1.0, 2.0, np.pi / 2, 2.0, -1.0, 3.0).at(np.array([-2.0, -0.5, 0.0, 1.0, 5.0]))
    assert places.xy_m[:, 1] == pytest.approx([1.0, 1.0, 2.0, 4.0, 5.0])
    assert places.speed_mps.tolist() == [0.0, 2.0, 2.0, 2.0, 0.0]
    places = Trajectory(100.0, 2.0, 0.0, 10.0, ring=True).at(np.array([0.0, 1.0, 2.0, 30.0]))
    assert places.xy_m[:, 0] == pytest.approx([100.0, 110.0, 120.0 - RING_M, 400.0 - 2 * RING_M])
    assert places.laps.tolist() == [0, 0, 1, 2]


@pytest.mark.parametrize("seed", range(3))
def test_nobody_touches_the_car_or_anybody_else(seed: int) -> None:
    world = scene(seed)
    assert world.ego.speed_mps * world.duration_s <= TRAVEL_M + 1e-9
    for time_s in np.arange(0.0, world.duration_s, 0.7):
        moment = world.at(time_s)
        boxes = [np.array([0.0, 0, 0, *EGO_M, 1, 0]), *(target.box for target in moment.scene.targets)]
        # Who walks side by side may touch shoulders.
        slack = [0.0, *(0.2 if target.type in ON_FOOT else 0.0 for target in moment.scene.targets)]
        shapes = [polygon(box - [0, 0, 0, s, s, 0, 0]) for box, s in zip(boxes, slack, strict=True)]
        tree = shapely.STRtree(shapes)
        for index, shape in enumerate(shapes):
            assert tree.query(shape, "intersects").tolist() == [index]


@pytest.mark.parametrize("seed", range(2))
def test_objects_go_where_their_velocity_says_and_keep_their_size(seed: int) -> None:
    world, step = scene(seed), 0.1
    seen = moved = 0
    for time_s in np.arange(0.0, world.duration_s - step, 1.3):
        before, after = world.at(time_s), world.at(time_s + step)
        later = dict(zip(after.track_ids, after.scene.targets, strict=True))
        for row, (number, target) in enumerate(zip(before.track_ids, before.scene.targets, strict=True)):
            if number not in later:
                x = target.box[0]
                assert abs(x) > FAR_M - 3 or abs(x + before.ego_pose[0, 3]) > RING_M / 2 - 3
                continue
            shift = later[number].box[:2] - target.box[:2] + after.ego_pose[:2, 3] - before.ego_pose[:2, 3]
            speeds = before.velocities_mps[row], shift / step
            # Who starts or stops between the two moments goes a part of it.
            assert np.hypot(*speeds[1]) <= np.hypot(*speeds[0]) + 8.0
            if np.allclose(*speeds, atol=1e-6):
                seen += 1
                moved += np.hypot(*shift) > 0
            assert later[number].box[3:6] == pytest.approx(target.box[3:6])
    assert seen > 50 and moved > 5


def test_held_footprints_cover_the_way() -> None:
    way = Trajectory(3.0, -2.0, 0.4, 5.0, -4.0, np.inf)
    held = shapely.union_all(
        [polygon(np.array([x, y, 0, a, b, 1, yaw])) for x, y, a, b, yaw in held_footprints(way, (2.0, 1.0), 10.0)]
    )
    for time_s in np.linspace(-5, 5, 40):
        x, y = way.at(np.array([time_s])).xy_m[0]
        assert held.buffer(1e-6).contains(polygon(np.array([x, y, 0, 2.0, 1.0, 1, 0.4])))
