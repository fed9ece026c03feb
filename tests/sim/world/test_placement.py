"""Objects stand where KITTI's stand, keep company, and never in each other."""

import numpy as np
import pytest

from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.world.placement import Habits, Neighbor, Occupied, Placer, Target, draw_size
from asca_pillars.sim.world.scene import KEPT_CLEAR_M, draw_scene, place_objects
from asca_pillars.sim.world.streets import draw_ground


def targets(config: SceneConfig, scenes: int) -> list[list[Target]]:
    """The objects of some streets, without what else stands there."""
    found = []
    for index in range(scenes):
        rng = np.random.default_rng(index)
        kind = ("residential", "urban", "rural", "campus")[index % 4]
        placer = Placer(rng, config, draw_ground(config, rng, kind), Occupied(), kind)
        assert placer.occupied.take(0.0, 0.0, *KEPT_CLEAR_M, 0.0)
        place_objects(placer)
        found.append(placer.targets)
    return found


def test_footprints_are_taken_once_and_two_seaters_are_rare() -> None:
    occupied = Occupied()
    assert occupied.take(0.0, 0.0, 4.0, 2.0, 0.3)
    assert not occupied.take(1.0, 0.5, 1.0, 1.0, 0.0)
    assert occupied.take(0.0, 2.2, 4.0, 2.0, 0.3)  # beside it, parallel
    assert not occupied.take(0.0, -2.2, 4.0, 2.0, 0.3, margin_m=0.5)
    lengths = np.array([draw_size(np.random.default_rng(seed), "Car")[0] for seed in range(2000)])
    assert 0.005 < (lengths < 2.9).mean() < 0.05
    assert lengths.min() < 2.6


def test_objects_stay_near_the_level_of_their_street() -> None:
    config = SceneConfig(relief_m=(2.5, 3.0))
    near, per_m = config.level_band_m
    for index in range(8):
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


def crowded(seed: int, kind: str = "residential") -> Placer:
    """A street with more vehicles, riders and walkers than there is room for."""
    rng, config = np.random.default_rng(seed), SceneConfig()
    placer = Placer(rng, config, draw_ground(config, rng, kind), Occupied(), kind)
    for name in ("Car",) * 40 + ("Cyclist",) * 15 + ("Pedestrian",) * 30:
        for ahead in (True, False):
            placer.place(name, ahead)
    return placer


def test_company_is_kept_with_what_stands_there_alone() -> None:
    """A place that was refused, as most are on a full street, must not attract others."""
    for seed in range(4):
        placer = crowded(seed)
        habits, places = placer.habits, np.array([target.box[:2] for target in placer.targets])
        for company in (habits.parked, habits.traffic, habits.people, habits.riders):
            for neighbor in company:
                x, y, _ = placer.ground.to_lidar(neighbor.u, neighbor.v)
                assert np.hypot(*(places - (x, y)).T).min() < 1.2  # they sway a little about their lane
        assert sum(map(len, (habits.parked, habits.traffic, habits.people, habits.riders))) <= len(places)


def test_companions_walk_half_a_metre_to_a_metre_apart() -> None:
    rng, config = np.random.default_rng(2), SceneConfig()
    habits = Habits(rng, config, draw_ground(config, rng, "urban"), "urban")
    habits.people.append(Neighbor(10.0, 5.0, 0.4, 0.0))
    apart = np.array([np.hypot(u - 10.0, v - 5.0) for u, v, _ in (habits.companion() for _ in range(400))])
    assert 0.45 < ((apart > 0.44) & (apart < 0.95)).mean() < 0.8
    close = 0
    for scene in targets(SceneConfig(empty_share=0.0, pedestrians=8.0), 20):
        places = np.array([target.box[:2] for target in scene if target.type == "Pedestrian"]).reshape(-1, 2)
        distance = np.linalg.norm(places[:, None] - places, axis=2) + 99.0 * np.eye(len(places))
        close += int((distance.min(axis=1, initial=99.0) < 0.8).sum())
    assert close > 15  # footprints that may not touch would keep them apart


@pytest.mark.parametrize(("name", "least", "most"), [("Pedestrian", 0.40, 0.70), ("Cyclist", 0.30, 0.65)])
def test_half_of_the_people_move_across_the_line_of_sight(name: str, least: float, most: float) -> None:
    boxes = np.array([t.box for scene in targets(SceneConfig(empty_share=0.0), 40) for t in scene if t.type == name])
    angle = boxes[:, 6] - np.arctan2(boxes[:, 1], boxes[:, 0])
    assert least < (np.abs(np.sin(angle)) > np.sin(np.pi / 4)).mean() < most


def test_streets_are_as_full_behind_and_beside_the_car_as_ahead() -> None:
    """What a camera sees is no more than what is there: labels all around need the rest."""
    objects = [
        target for seed in range(6) for kind in ("residential", "urban") for target in crowded(seed, kind).targets
    ]
    for name in ("Pedestrian", "Cyclist", "Car"):
        boxes = np.array([target.box for target in objects if target.type == name])
        assert len(boxes) > 150
        assert (boxes[:, 0] > 0).mean() == pytest.approx(0.5, abs=0.08)
        assert (boxes[:, 1] > 0).mean() == pytest.approx(0.5, abs=0.17)  # the car keeps to the right of its street
        assert (np.abs(boxes[:, 0]) < np.abs(boxes[:, 1])).mean() > 0.05
