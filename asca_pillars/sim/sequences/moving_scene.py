"""A street on which the car and the road users move, at any moment of a sequence."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.sequences.ways import Going, Way, draw_ways, held_footprints
from asca_pillars.sim.world.placement import Placer, Target
from asca_pillars.sim.world.scene import KEPT_CLEAR_M, Scene, draw_scene

Floats = npt.NDArray[np.float64]

FAR_M = 115.0  # beyond it an object is out of every sensor's reach
MAX_RELIEF_M = 0.5  # the car does not pitch, so that its street has to be level


class Moment(NamedTuple):
    """The street as the sensor finds it at one moment, in the LiDAR frame of that moment."""

    scene: Scene
    track_ids: tuple[int, ...]
    """Of each of `scene.targets`; the same object keeps its number."""
    velocities_mps: Floats
    """(M, 2) over ground, along the frame's x and y."""
    ego_pose: Floats
    """(4, 4) from the LiDAR frame to the world, metres."""


@dataclass(frozen=True)
class MovingScene:
    """The street in the middle of the sequence, with the ways of the car and of each of its targets."""

    scene: Scene
    ego: Way
    ways: tuple[Way, ...]
    duration_s: float

    def at(self, time_s: float) -> Moment:
        """The street `time_s` after the sequence's start."""
        times = np.array([time_s - self.duration_s / 2])
        driven = float(self.ego.at(times).xy_m[0, 0])
        ground = self.scene.ground
        here, there = ground.heights([(0.0, 0.0), (driven, 0.0)])
        lifted = float(there - here)  # the sensor is as high above the street as it was
        street = ground.street._replace(along_m=driven, cross_u_m=ground.street.cross_u_m - driven)
        targets, ids, velocities = [], [], []
        for index, (target, way) in enumerate(zip(self.scene.targets, self.ways, strict=True)):
            place = way.at(times)
            x, y = place.xy_m[0].tolist()
            if abs(x - driven) > FAR_M:
                continue
            box = target.box.copy()
            box[:3] = x - driven, y, float(ground.heights((x, y))[0]) + target.lift_m + box[5] / 2 - lifted
            box[6] = (way.heading_rad + np.pi) % (2 * np.pi) - np.pi
            walked = float(place.gone_m[0]) if target.type == "Pedestrian" else 0.0
            targets.append(replace(target, box=box, walked_m=walked))
            ids.append(index + len(self.ways) * _unsigned(int(place.laps[0])))
            velocities.append(place.speed_mps[0] * np.array([np.cos(way.heading_rad), np.sin(way.heading_rad)]))
        pose = np.eye(4)
        pose[:3, 3] = driven, 0.0, lifted
        scene = replace(
            self.scene,
            ground=replace(ground, street=street, z_m=ground.z_m - lifted),
            targets=tuple(targets),
            background=self.scene.background.placed(-driven, 0.0, -lifted, 0.0),
        )
        return Moment(scene, tuple(ids), np.array(velocities).reshape(-1, 2), pose)


def draw_moving_scene(
    config: SceneConfig, rng: np.random.Generator, rng_of_ways: np.random.Generator, duration_s: float
) -> MovingScene:
    """A random street and what goes on in it for `duration_s`.

    It is straight, level and never empty, and the car keeps its lane: `config` has no say in that.
    """
    straight = replace(
        config,
        empty_share=0.0,
        bend_sigma_per_m=0.0,
        heading_error_sigma_rad=0.0,
        turning_share=0.0,
        relief_m=(0.0, min(config.relief_m[1], MAX_RELIEF_M)),
    )
    ego, going = Way(0.0, 0.0, 0.0), list[Going]()

    def arrange(placer: Placer) -> None:
        nonlocal ego, going
        near = [target for target in placer.targets if abs(target.box[0]) < config.reach_m]
        ego, going = draw_ways(near, placer.ground, placer.kind, duration_s, rng_of_ways)
        kept = [item.target for item in going]
        placer.targets[:] = kept
        placer.half_hidden[:] = [target for target in placer.half_hidden if any(target is one for one in kept)]
        for way, size in [(ego, KEPT_CLEAR_M), *((way, _size(target)) for target, way in going)]:
            for footprint in held_footprints(way, size, duration_s):
                placer.occupied.hold(*footprint)

    scene = draw_scene(straight, rng, arrange)
    return MovingScene(scene, ego, tuple(item.way for item in going), duration_s)


def _size(target: Target) -> tuple[float, float]:
    return float(target.box[3]), float(target.box[4])


def _unsigned(lap: int) -> int:
    """0, 1, 2, 3, 4 for 0, -1, 1, -2, 2: laps as numbers that can be part of an identity."""
    return 2 * lap if lap >= 0 else -2 * lap - 1
