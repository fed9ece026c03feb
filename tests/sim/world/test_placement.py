"""Objects stand where KITTI's stand, keep company, and never in each other."""

import numpy as np

from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.world.occupied import Occupied
from asca_pillars.sim.world.placement import Target
from asca_pillars.sim.world.scene import draw_scene


def targets(config: SceneConfig, scenes: int) -> list[list[Target]]:
    return [list(draw_scene(config, np.random.default_rng(index)).targets) for index in range(scenes)]


def test_a_footprint_is_taken_once() -> None:
    occupied = Occupied()
    assert occupied.take(0.0, 0.0, 4.0, 2.0, 0.3)
    assert not occupied.take(1.0, 0.5, 1.0, 1.0, 0.0)
    assert occupied.take(0.0, 2.2, 4.0, 2.0, 0.3)  # beside it, parallel
    assert not occupied.take(0.0, -2.2, 4.0, 2.0, 0.3, margin_m=0.5)


def test_objects_stay_near_the_level_of_their_street() -> None:
    config = SceneConfig(relief_m=(2.5, 3.0))
    near, per_m = config.level_band_m
    for index in range(20):
        scene = draw_scene(config, np.random.default_rng(index))
        for target in scene.targets:
            x, y, z, _, _, height, _ = target.box
            rise = z - height / 2 - target.lift_m - scene.ground.z_m
            rise -= config.slope_x[0] * x + config.slope_y[0] * y
            assert abs(rise) < near + per_m * np.hypot(x, y) + 1e-9


def test_people_come_in_groups() -> None:
    """A third of all people have somebody within 2 m, where as many strewn at random hardly ever would."""
    close, people = 0, 0
    for scene in targets(SceneConfig(empty_share=0.0), 45):
        places = np.array([target.box[:2] for target in scene if target.type == "Pedestrian"]).reshape(-1, 2)
        if len(places) > 1:
            distance = np.linalg.norm(places[:, None] - places, axis=2) + 99.0 * np.eye(len(places))
            close += int((distance.min(axis=1) < 2.0).sum())
            people += len(places)
    assert people > 80
    assert close / people > 0.25


def test_cars_beyond_reach_are_only_there_when_asked_for() -> None:
    def far(config: SceneConfig) -> list[Target]:
        return [target for scene in targets(config, 25) for target in scene if np.hypot(*target.box[:2]) > 86.0]

    assert len(far(SceneConfig(empty_share=0.0))) > 8
    assert not far(SceneConfig(empty_share=0.0, beyond=0.0))
