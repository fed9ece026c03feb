"""Things before vehicles hide a part of them and no more; narrow things stand behind their ends."""

import numpy as np
import pytest

from asca_pillars.sim.casting.raycast import cast
from asca_pillars.sim.lidar import Lidar, draw_firings
from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.world.builder import Builder
from asca_pillars.sim.world.clutter import fill_gaps, hide_partly
from asca_pillars.sim.world.placement import Occupied, Target
from asca_pillars.sim.world.scene import Scene, build, draw_calibration
from asca_pillars.sim.world.streets import draw_ground


def scene_with_car(seed: int, config: SceneConfig) -> tuple[Builder, Target]:
    """An empty street, and a car some way ahead to the left of it."""
    rng = np.random.default_rng(seed)
    ground = draw_ground(config, rng, "urban")
    x, y = 24.0, 11.0
    z = float(ground.heights((x, y))[0])
    target = Target("Car", np.array([x, y, z + 0.75, 4.0, 1.65, 1.5, 0.3]))
    occupied = Occupied()
    assert occupied.take(x, y, 4.0, 1.65, 0.3)
    return Builder(rng, config, ground, occupied, "urban"), target


def visible_share(builder: Builder, target: Target, seed: int) -> float:
    scene = Scene(builder.ground, (target,), builder.primitives(), draw_calibration(builder.rng))
    firings = draw_firings(Lidar(), np.random.default_rng(seed), camera_only=True)
    hits = cast(build(scene, builder.config, (seed, 0), 1.0), 1, builder.ground, firings, seed)
    return float(hits.visible[0] / max(hits.alone[0], 1))


def test_a_half_hidden_car_is_seen_in_part_over_a_free_way() -> None:
    found = []
    for seed in range(12):
        builder, target = scene_with_car(seed, SceneConfig())
        hide_partly(builder, [target])
        found.append(visible_share(builder, target, seed))
    shares = np.array(found)
    assert (shares > 0.05).mean() > 0.8
    assert ((shares > 0.05) & (shares < 0.95)).mean() > 0.4
    builder, target = scene_with_car(3, SceneConfig())
    hide_partly(builder, [target])
    for share in (0.4, 0.5):  # nearer than what stands before it
        x, y = share * target.box[:2]
        assert not builder.occupied.take(float(x), float(y), 0.5, 0.5, 0.0)


@pytest.mark.parametrize(("share", "expected"), [(0.0, 0), (1.0, 1)])
def test_gaps_are_filled_behind_as_many_vehicles_as_asked_for(share: float, expected: int) -> None:
    builder, target = scene_with_car(5, SceneConfig(behind_gaps=share))
    taken = builder.occupied.count
    fill_gaps(builder, [target, Target("Pedestrian", np.array([9.0, 3.0, -0.8, 0.8, 0.6, 1.7, 0.0]))])
    placed = builder.occupied.rows[taken : builder.occupied.count]
    assert len(placed) >= expected
    if expected == 0:
        assert len(placed) == 0
    else:
        assert (np.hypot(placed[:, 0], placed[:, 1]) > np.hypot(*target.box[:2]) - 3.0).all()
