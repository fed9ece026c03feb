"""Street on which the car and the road users move on straight paths at constant speed."""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from asca_pillars.geometry.boxes import Floats, Ints
from asca_pillars.geometry.overlap import paired_bev_touch
from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.world.ground import Ground
from asca_pillars.sim.world.placement import ON_FOOT, Placer, Target
from asca_pillars.sim.world.scene import KEPT_CLEAR_M, Scene, draw_scene

TRAVEL_M = 60.0  # the car's longest path: the scene's street is 170 m long, and the sensor's range is 80 m
RING_M = 230.0  # traffic that leaves the street at one end returns as another object at the other
LANE_M = 3.0
# Speeds, metres per second: of traffic by the kind of street, on crossing roads, of riders and walkers.
FLOW_MPS = {"residential": (4.0, 9.0), "urban": (5.0, 12.0), "rural": (8.0, 18.0), "campus": (3.0, 8.0)}
CROSSING_MPS, RIDING_MPS, WALKING_MPS = (3.0, 8.0), (2.5, 6.5), (0.8, 1.8)
STANDING_SHARE = 0.15  # of lanes with waiting traffic, and of walkers and riders
WALK_M = 25.0  # a walker stops at this distance from its initial position
EGO_M = (4.6, 2.2)  # length and width of the car
# Margin added to a footprint's length and width within which two of them may not touch.
APART_M, PEOPLE_APART_M = 0.5, -0.2
STEP_S = 0.1
_HELD_M = 12.0


@dataclass(frozen=True)
class Trajectory:
    """Straight path through the world.

    Attributes:
        x_m, y_m: position in the middle of the sequence, or without a stop before.
        heading_rad: direction of motion.
        speed_mps: speed while moving.
        from_m, to_m: start and stop along its heading from there.
        ring: the path is a loop of RING_M instead.
    """

    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float = 0.0
    from_m: float = -np.inf
    to_m: float = np.inf
    ring: bool = False

    def at(self, times_s: Floats) -> "TrajectoryPoints":
        """Return poses at times (T,), seconds from the middle of the sequence."""
        gone = np.asarray(times_s, float) * self.speed_mps
        way = np.clip(gone, self.from_m, self.to_m)
        x, y = self.x_m + way * np.cos(self.heading_rad), self.y_m + way * np.sin(self.heading_rad)
        laps = np.zeros(len(way), np.int64)
        if self.ring:
            laps = np.floor(x / RING_M + 0.5).astype(np.int64)
            x = x - RING_M * laps
        speed = np.where((way == gone) & (self.speed_mps > 0), self.speed_mps, 0.0)
        return TrajectoryPoints(np.column_stack([x, y]), way, speed, laps)


class TrajectoryPoints(NamedTuple):
    """Positions on a path at T times."""

    xy_m: Floats
    """(T, 2) positions."""
    gone_m: Floats
    """(T,) distance along the path, from its middle."""
    speed_mps: Floats
    """(T,) current speed."""
    laps: Ints
    """(T,) number of times it has left the street."""


class MovingTarget(NamedTuple):
    """Object and its path."""

    target: Target
    way: Trajectory


def draw_trajectories(
    targets: list[Target], ground: Ground, kind: str, duration_s: float, rng: np.random.Generator
) -> tuple[Trajectory, list[MovingTarget]]:
    """Return the path of the car, and those of the objects that never touch the car or each other.

    An object whose path is not free does not move; one that is still in the way is left out.

    Args:
        targets: the placed objects.
        ground: a straight street along x.
        kind: kind of the street, for the speed of its traffic.
        duration_s: duration of the sequence.
        rng: generator of the sequence.
    """
    flow: dict[tuple[int, float], float] = {}
    limit = TRAVEL_M / duration_s
    lane = _lane(0.0, ground)
    ego = Trajectory(0.0, 0.0, 0.0, min(float(rng.uniform(*FLOW_MPS[kind])), limit))
    flow[lane, 0.0] = ego.speed_mps
    times = np.arange(-duration_s / 2, duration_s / 2 + STEP_S, STEP_S)
    taken = [_footprints(ego, times, (*EGO_M, 0.0), APART_M)]
    drawn = [_way(target, ground, kind, flow, rng) for target in targets]
    kept: dict[int, MovingTarget] = {}
    # Objects that cannot move come first: they have no alternative.
    for index in sorted(range(len(targets)), key=lambda index: drawn[index].speed_mps > 0):
        target = targets[index]
        x, y, _, *size, yaw = target.box
        apart = PEOPLE_APART_M if target.type in ON_FOOT else APART_M
        drawn_way = drawn[index]
        # Traffic does not stop in its lane: following vehicles would hit it.
        for way in (drawn_way,) if drawn_way.ring else (drawn_way, Trajectory(x, y, yaw)):
            footprints = _footprints(way, times, size, apart)
            if not any(_touch(footprints, other) for other in taken):
                taken.append(footprints)
                kept[index] = MovingTarget(target, way)
                break
    return ego, [kept[index] for index in sorted(kept)]


def held_footprints(way: Trajectory, size: tuple[float, float], duration_s: float) -> list[tuple[float, ...]]:
    """Return footprints x, y, length, width, yaw, metres, that cover all of a path during a sequence."""
    length, width = size
    half = way.speed_mps * duration_s / 2
    low, high = max(-half, way.from_m), min(half, way.to_m)
    if way.ring:
        low, high = -way.x_m * np.cos(way.heading_rad) - RING_M / 2, -way.x_m * np.cos(way.heading_rad) + RING_M / 2
    pieces = max(int(np.ceil((high - low) / _HELD_M)), 1)
    edges = np.linspace(low, high, pieces + 1)
    cos, sin = np.cos(way.heading_rad), np.sin(way.heading_rad)
    return [
        (way.x_m + (a + b) / 2 * cos, way.y_m + (a + b) / 2 * sin, b - a + length, width, way.heading_rad)
        for a, b in pairwise(edges.tolist())
    ]


def _way(
    target: Target, ground: Ground, kind: str, flow: dict[tuple[int, float], float], rng: np.random.Generator
) -> Trajectory:
    """Return a path for the object's motion; other objects are not considered."""
    x, y, yaw = float(target.box[0]), float(target.box[1]), float(target.box[6])
    still, waits = Trajectory(x, y, yaw), rng.random() < STANDING_SHARE
    along = 0.0 if np.cos(yaw) > 0 else np.pi
    aside = y - ground.to_lidar(0.0, 0.0)[1]  # distance from the middle of the road
    if target.going == "lane":
        key = (_lane(y, ground), along)
        if key not in flow:
            flow[key] = 0.0 if waits else float(rng.uniform(*FLOW_MPS[kind]))
        return Trajectory(x, y, along, flow[key], ring=True)
    if target.going == "crossing":
        return still if waits else Trajectory(x, y, yaw, float(rng.uniform(*CROSSING_MPS)))
    edge = max(abs(aside), ground.half_width_m + ground.pavement_m + 0.3)
    if target.going == "riding" and abs(np.sin(yaw)) < 0.5:
        # All of the path along the street has to be free, so that riders keep to the pavement.
        side = float(np.sign(aside)) * min(abs(aside), ground.half_width_m + max(ground.pavement_m, 1.0))
        return still if waits else Trajectory(x, y - aside + side, along, float(rng.uniform(*RIDING_MPS)), ring=True)
    if target.going in ("riding", "walking") and not waits:
        speed = float(rng.uniform(*(RIDING_MPS if target.going == "riding" else WALKING_MPS)))
        ends = np.sort((np.array([-edge, edge]) - aside) / (np.sin(yaw) or 1e-9))
        low, high = np.clip(ends, -WALK_M, WALK_M)
        return Trajectory(x, y, yaw, speed, float(low), float(high))
    return still


def _lane(y_m: float, ground: Ground) -> int:
    return int(np.floor((y_m - ground.to_lidar(0.0, 0.0)[1]) / LANE_M))


def _footprints(way: Trajectory, times_s: Floats, size: ArrayLike, apart_m: float) -> Floats:
    """Return (T, 7) boxes, of which only the footprints are used."""
    boxes = np.zeros((len(times_s), 7))
    boxes[:, :2] = way.at(times_s).xy_m
    boxes[:, 3:6] = size
    boxes[:, 3:5] = np.maximum(boxes[:, 3:5] + apart_m, 0.1)
    boxes[:, 6] = way.heading_rad
    return boxes


def _touch(a: Floats, b: Floats) -> bool:
    close = np.hypot(*(a[:, :2] - b[:, :2]).T) < (np.hypot(*a[0, 3:5]) + np.hypot(*b[0, 3:5])) / 2
    return bool(close.any() and paired_bev_touch(a[close], b[close]).any())


FAR_M = 115.0  # beyond every sensor's range
MAX_RELIEF_M = 0.5  # the car does not pitch, so its street has to be level


class SceneState(NamedTuple):
    """Street at one time, in the LiDAR frame of that time."""

    scene: Scene
    track_ids: tuple[int, ...]
    """Identity of each of `scene.targets`, the same in all frames."""
    velocities_mps: Floats
    """(M, 2) over ground, along the frame's x and y."""
    ego_pose: Floats
    """(4, 4) from the LiDAR frame to the world, metres."""


@dataclass(frozen=True)
class MovingScene:
    """Street in the middle of the sequence, with the paths of the car and of each of its targets."""

    scene: Scene
    ego: Trajectory
    trajectories: tuple[Trajectory, ...]
    duration_s: float

    def at(self, time_s: float) -> SceneState:
        """Return the street `time_s` after the sequence's start."""
        times = np.array([time_s - self.duration_s / 2])
        driven = float(self.ego.at(times).xy_m[0, 0])
        ground = self.scene.ground
        start_ground_m, ego_ground_m = ground.heights([(0.0, 0.0), (driven, 0.0)])
        lifted = float(ego_ground_m - start_ground_m)  # the sensor's height above the street is constant
        street = ground.street._replace(along_m=driven, cross_u_m=ground.street.cross_u_m - driven)
        targets, ids, velocities = [], [], []
        for index, (target, way) in enumerate(zip(self.scene.targets, self.trajectories, strict=True)):
            place = way.at(times)
            x, y = place.xy_m[0].tolist()
            if abs(x - driven) > FAR_M:
                continue
            box = target.box.copy()
            box[:3] = x - driven, y, float(ground.heights((x, y))[0]) + target.lift_m + box[5] / 2 - lifted
            box[6] = (way.heading_rad + np.pi) % (2 * np.pi) - np.pi
            walked = float(place.gone_m[0]) if target.type == "Pedestrian" else 0.0
            targets.append(replace(target, box=box, walked_m=walked))
            ids.append(index + len(self.trajectories) * _unsigned(int(place.laps[0])))
            velocities.append(place.speed_mps[0] * np.array([np.cos(way.heading_rad), np.sin(way.heading_rad)]))
        pose = np.eye(4)
        pose[:3, 3] = driven, 0.0, lifted
        scene = replace(
            self.scene,
            ground=replace(ground, street=street, z_m=ground.z_m - lifted),
            targets=tuple(targets),
            background=self.scene.background.placed(-driven, 0.0, -lifted, 0.0),
        )
        return SceneState(scene, tuple(ids), np.array(velocities).reshape(-1, 2), pose)


def draw_moving_scene(
    config: SceneConfig, rng: np.random.Generator, rng_of_ways: np.random.Generator, duration_s: float
) -> MovingScene:
    """Draw a random street and the motion on it for `duration_s`.

    It is straight, level and never empty, and the car keeps its lane, whatever `config` states.
    """
    straight = replace(
        config,
        empty_share=0.0,
        bend_sigma_per_m=0.0,
        heading_error_sigma_rad=0.0,
        turning_share=0.0,
        relief_m=(0.0, min(config.relief_m[1], MAX_RELIEF_M)),
    )
    ego, going = Trajectory(0.0, 0.0, 0.0), list[MovingTarget]()

    def arrange(placer: Placer) -> None:
        nonlocal ego, going
        targets = [target for target in placer.targets if abs(target.box[0]) < config.reach_m]
        ego, going = draw_trajectories(targets, placer.ground, placer.kind, duration_s, rng_of_ways)
        kept = [item.target for item in going]
        placer.targets[:] = kept
        placer.half_hidden[:] = [target for target in placer.half_hidden if any(target is other for other in kept)]
        for way, size in [(ego, KEPT_CLEAR_M), *((way, _size(target)) for target, way in going)]:
            for footprint in held_footprints(way, size, duration_s):
                placer.occupied.hold(*footprint)

    scene = draw_scene(straight, rng, arrange)
    return MovingScene(scene, ego, tuple(item.way for item in going), duration_s)


def _size(target: Target) -> tuple[float, float]:
    return float(target.box[3]), float(target.box[4])


def _unsigned(lap: int) -> int:
    """Map laps 0, -1, 1, -2, 2 to 0, 1, 2, 3, 4, which can be part of an identity."""
    return 2 * lap if lap >= 0 else -2 * lap - 1
