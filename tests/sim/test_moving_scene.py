"""The street stays where it is while the car drives: its ground, its things, and people who walk on it."""

from dataclasses import replace

import numpy as np
import pytest

from asca_pillars.sim.bodies.people import pedestrian_body
from asca_pillars.sim.bodies.primitives import Primitives
from asca_pillars.sim.casting.groundcast import RELIEF_STEP_M, ground_material
from asca_pillars.sim.casting.raycast import Bodies, cast
from asca_pillars.sim.lidar import Lidar, draw_firings
from asca_pillars.sim.moving_scene import MovingScene, draw_moving_scene
from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.world.streets import draw_ground


def scene(seed: int) -> MovingScene:
    return draw_moving_scene(SceneConfig(), np.random.default_rng([seed, 0]), np.random.default_rng([seed, 1]), 10.0)


@pytest.mark.parametrize("seed", range(2))
def test_ground_and_markings_stay_in_the_world(seed: int) -> None:
    world, moment = scene(seed), scene(seed).at(9.0)
    driven, _, lifted = moment.ego_pose[:3, 3]
    assert driven > 5
    places = np.random.default_rng(seed).uniform([-60, -40], [60, 40], (2000, 2))
    moved = places - [driven, 0.0]
    heights = world.scene.ground.heights(places)
    assert moment.scene.ground.heights(moved) + lifted == pytest.approx(heights, abs=1e-9)
    before = [ground_material(x, y, world.scene.ground.street) for x, y in places]
    after = [ground_material(x, y, moment.scene.ground.street) for x, y in moved]
    assert np.mean(np.equal(before, after)) > 0.999 and len(set(before)) > 2
    under = moment.scene.ground.heights((0.0, 0.0))[0]
    assert under == pytest.approx(world.scene.ground.heights((0.0, 0.0))[0]), "the sensor is as high as before"


@pytest.mark.parametrize("seed", range(2))
def test_rays_meet_the_ground_that_has_moved(seed: int) -> None:
    """Hills shifted by whole steps of their lattice are another lattice, whose rays need no shift."""
    steep = SceneConfig(bend_sigma_per_m=0.0, heading_error_sigma_rad=0.0, turning_share=0.0, relief_m=(2.0, 4.0))
    ground = draw_ground(steep, np.random.default_rng(seed), "rural")
    steps = 6
    driven = steps * RELIEF_STEP_M
    street = ground.street._replace(cross_u_m=ground.street.cross_u_m - driven)
    rolled = ground.relief[np.minimum(np.arange(len(ground.relief)) + steps, len(ground.relief) - 1)]
    there = replace(ground, street=street, relief=rolled)
    z_m = ground.z_m + ground.z_m - float(there.heights((0.0, 0.0))[0])
    firings = draw_firings(Lidar(), np.random.default_rng(1), camera_only=False)
    nothing = Primitives.join([])
    none = np.zeros(0, np.int64)
    shifted = replace(ground, street=street._replace(along_m=driven), z_m=z_m)
    grounds = replace(there, z_m=z_m), shifted
    first, second = (cast(Bodies(nothing, none, none, none, none), 0, one, firings, 5).rho_m for one in grounds)
    near = first < 60  # beyond, the rolled lattice is at its end
    assert near.mean() > 0.3
    assert np.quantile(np.abs(first[near] - second[near]), 0.999) < 0.01


def test_a_person_walks_and_stays_the_same_person() -> None:
    still, on = (pedestrian_body(np.random.default_rng(4), 1.7, 0.6, 1.1, walked_m=way) for way in (0.0, 0.4))
    cycle = pedestrian_body(np.random.default_rng(4), 1.7, 0.6, 1.1, walked_m=4 * (1.1 / 2 - 0.07))
    assert len(still.centers) == len(on.centers)
    assert np.array_equal(still.ellipsoid_surface, on.ellipsoid_surface)
    moved = np.linalg.norm(still.centers - on.centers, axis=1)
    assert moved.max() > 0.1 and moved.min() == 0.0, "legs and arms move, the head does not"
    assert cycle.centers == pytest.approx(still.centers), "after two steps the legs are where they were"
