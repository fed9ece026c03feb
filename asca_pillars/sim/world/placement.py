"""Labelled objects on their street: sizes by KITTI's statistics, and free positions.

Each class has its habits, standing or moving; u runs along the street, v to its left.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from asca_pillars.base.compiling import cached
from asca_pillars.geometry.boxes import Floats
from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.world.ground import Ground

QUARTER_TURNS = (0.0, np.pi, np.pi / 2, -np.pi / 2)
NOSE_IN_M, ALONG_M = (0.5, 1.1), (0.4, 1.8)  # gaps between parked cars side by side and one behind the other


MotionKind: TypeAlias = Literal["still", "lane", "crossing", "riding", "walking"]
"""Motion of an object: used in a sequence, not in a single scan."""


class Neighbor(NamedTuple):
    """Position of an object that others may be next to: metres, heading relative to the street, length of its box."""

    u: float
    v: float
    heading: float
    length: float


class Candidate(NamedTuple):
    """Pose for an object, before a check that it is free."""

    place: tuple[float, float, float]  # x, y, heading in the LiDAR frame
    company: list[Neighbor] | None = None  # list that it joins as a neighbor once it is placed
    neighbor: Neighbor | None = None
    half_hidden: bool = False  # to be partly occluded by another object
    going: MotionKind = "still"


class Habits:
    """Sampler of poses for the objects of one scene, many of them next to others already placed."""

    def __init__(self, rng: np.random.Generator, config: SceneConfig, ground: Ground, kind: str) -> None:
        self.rng, self.config, self.ground = rng, config, ground
        self.parked_share = float(getattr(config, f"parked_{kind}"))
        self.square = kind == "campus"
        self.parked: list[Neighbor] = []
        self.traffic: list[Neighbor] = []
        self.people: list[Neighbor] = []
        self.riders: list[Neighbor] = []
        # Zebra crossings are at junctions, or anywhere: one ahead, one behind.
        at_junction = ground.cross_half_m > 0 and rng.random() < config.zebra_at_junction
        corner_u_m = ground.cross_u_m - rng.choice([-1.0, 1.0]) * (ground.cross_half_m + 2.5)
        anywhere = float(rng.uniform(6.0, 45.0))
        self.zebra_u = (
            float(corner_u_m) if at_junction and corner_u_m > 0 else anywhere,
            float(corner_u_m) if at_junction and corner_u_m < 0 else -anywhere,
        )

    def vehicle(self, size: Floats, way: float) -> Candidate:
        """Return a pose for a car, van, truck or trailer: parked, in a yard, partly occluded, crossing, or driving.

        Its size (3,) is length, width and height in metres; `way` is 1 ahead of the sensor and -1 behind it, here and
        below.
        """
        rng, config = self.rng, self.config
        if size[0] < 6.0 and rng.random() < config.half_hidden:
            return self._half_hidden(way)
        habit = rng.random()
        parked = self.parked_share * (0.3 if size[0] > 6.0 else 1.0)
        if self.ground.cross_half_m > 0 and habit > 1.0 - config.on_crossing_road:
            return self._crossing()
        if habit < parked:
            return self._parked(size, way)
        if habit < parked + config.off_street:
            return self._off_street(size, way)
        return self._moving(size, way)

    def tram(self, size: Floats, way: float) -> Candidate:
        """Return a pose for a tram of size (3,) in metres on its track, or beside the road."""
        rails = self.ground.rails_v_m
        v = self.ground.half_width_m + 3.0 if rails is None else rails
        return Candidate(
            self.ground.to_lidar(way * self.rng.uniform(8.0, 74.0), v, self.rng.choice([0.0, np.pi])), going="lane"
        )

    def pedestrian(self, size: Floats, way: float) -> Candidate:
        """Return a pose for a pedestrian of size (3,), metres, alone or in company; along the street or across it."""
        rng, config, ground = self.rng, self.config, self.ground
        half, pavement = ground.half_width_m, ground.pavement_m
        if self.people and rng.random() < config.in_company:
            u, v, heading = self.companion()
        else:
            u = way * self._distance(2.0, 6.6)
            habit = rng.random()
            heading = float(rng.choice([0.0, np.pi]) + rng.normal(0, 0.15))
            if habit < config.on_zebra:
                u = self.zebra_u[0 if way > 0 else 1] + rng.uniform(-1.5, 1.5)
                v, heading = rng.uniform(-half - 1.0, half + 1.0), heading + np.pi / 2
            elif self.square and habit < 0.6:
                v = rng.uniform(-12.0, 12.0)
            elif habit < config.on_zebra + config.walking_in_road:
                v = rng.uniform(-half, half)
            else:
                beyond = pavement + rng.uniform(0.0, 8.0) if rng.random() < config.beyond_pavement else 0.0
                v = rng.choice([-1.0, 1.0]) * (half + beyond + rng.uniform(0.1, max(pavement, 1.0) + 1.5))
            heading = self._turned(heading, u, v)
        return self._at(self.people, u, v, heading, going="walking")

    def _turned(self, heading: float, u: float, v: float) -> float:
        """Return a walker's heading relative to the street: the given one, random, or across the line of sight."""
        rng, config = self.rng, self.config
        if rng.random() < config.pedestrian_uniform_heading:
            return float(rng.uniform(-np.pi, np.pi))
        if rng.random() < config.pedestrian_across_sight:
            x, y, along = self.ground.to_lidar(u, v)
            return float(np.arctan2(y, x) - along + rng.choice([-1.0, 1.0]) * np.pi / 2 + rng.normal(0.0, 0.35))
        return heading

    def companion(self) -> tuple[float, float, float]:
        """Return u, v and heading of a person next to another one with the same heading, behind, or face to face."""
        rng, config = self.rng, self.config
        of = self.people[int(rng.integers(len(self.people)))]
        habit = rng.random()
        if habit < config.side_by_side:
            along, turn = rng.normal(0, 0.15), rng.normal(0, 0.12)
            across = rng.choice([-1, 1]) * rng.uniform(*config.side_by_side_m)
        elif habit < 0.5 + 0.5 * config.side_by_side:
            along, across = rng.choice([-1, 1]) * rng.uniform(0.8, 2.2), rng.normal(0, 0.5)
            turn = rng.normal(0, 0.2)
        else:
            along, across, turn = rng.uniform(0.6, 1.2), rng.normal(0, 0.3), np.pi + rng.normal(0, 0.5)
        cos, sin = np.cos(of.heading), np.sin(of.heading)
        return float(of.u + along * cos - across * sin), float(of.v + along * sin + across * cos), of.heading + turn

    def sitting(self, size: Floats, way: float) -> Candidate:
        """Return a pose for a person of size (3,) in metres on a bench or a chair beside the street, or at a table."""
        rng, ground = self.rng, self.ground
        if self.people and rng.random() < 0.4:
            other = self.people[int(rng.integers(len(self.people)))]
            u, v = other.u + rng.normal(0, 1.0), other.v + rng.normal(0, 1.0)
        else:
            u = way * self._distance(2.5, 4.2)
            v = rng.choice([-1.0, 1.0]) * (ground.half_width_m + rng.uniform(0.6, max(ground.pavement_m, 1.0) + 2.0))
        return self._at(self.people, u, v, rng.uniform(-np.pi, np.pi))

    def cyclist(self, size: Floats, way: float) -> Candidate:
        """Return a pose for a cyclist of size (3,) in metres, on the road or beside it, along or across it."""
        rng, config, half = self.rng, self.config, self.ground.half_width_m
        if self.riders and rng.random() < config.riding_together:  # side by side, or one behind the other
            u, v, heading, _ = self.riders[int(rng.integers(len(self.riders)))]
            overtakes = rng.random() < 0.4
            u += rng.normal(0, 0.4) if overtakes else rng.choice([-1, 1]) * rng.uniform(2.2, 6.0)
            v += rng.choice([-1, 1]) * rng.uniform(0.8, 1.3) if overtakes else rng.normal(0, 0.3)
        elif rng.random() < config.cyclist_crossing:
            u, v = way * self._distance(2.0, 12.5), rng.uniform(-half - 6.0, half + 6.0)
            heading = float(rng.choice([-1, 1]) * np.pi / 2 + rng.normal(0, 0.45))
        else:
            u = way * self._distance(2.0, 12.5)
            side = -1.0 if rng.random() < 0.6 else 1.0
            v = side * (half + (rng.uniform(-1.3, -0.3) if rng.random() < 0.5 else rng.uniform(0.4, 7.0)))
            against = rng.random() < config.riding_against_traffic
            heading = (np.pi if (side > 0) != against else 0.0) + rng.normal(0, 0.12)
        return self._at(self.riders, u, v, heading, going="riding")

    def _at(
        self,
        company: list[Neighbor],
        u: float,
        v: float,
        heading: float,
        length: float = 0.0,
        sway: tuple[float, float] = (0.0, 0.0),
        *,
        going: MotionKind = "still",
    ) -> Candidate:
        """Return a candidate that joins `company` once placed; `sway` is the spread of its position and heading."""
        across, turn = (float(self.rng.normal(0.0, spread)) if spread else 0.0 for spread in sway)
        place = self.ground.to_lidar(u, v + across, heading + turn)
        return Candidate(place, company, Neighbor(float(u), float(v), float(heading), float(length)), going=going)

    def _distance(self, shape: float, scale: float) -> float:
        """Return a distance along the street, metres: as KITTI's labels in the camera's view, or beside the car."""
        if self.rng.random() < self.config.alongside:
            return float(self.rng.uniform(0.0, 7.0))
        distance = float(self.rng.gamma(shape, scale))
        return distance if 2.0 < distance < self.config.reach_m else float(self.rng.uniform(2.0, self.config.reach_m))

    def _crossing(self) -> Candidate:
        """Return a pose on the crossing road, in the right-hand lane."""
        rng, ground = self.rng, self.ground
        lane = -1.0 if rng.random() < 0.5 else 1.0
        across = lane * ground.cross_half_m * rng.uniform(0.4, 0.65)
        heading = (0.0 if lane > 0 else np.pi) + rng.normal(0, 0.06)
        return Candidate(ground.cross_to_lidar(rng.uniform(-45.0, 45.0), across, heading), going="crossing")

    def _parked(self, size: Floats, way: float) -> Candidate:
        """Return a pose at the kerb, half on the pavement or nose in; mostly next to a parked one."""
        rng, config, half = self.rng, self.config, self.ground.half_width_m
        if self.parked and rng.random() < config.next_to_parked:
            u, v, heading, length = self.parked[int(rng.integers(len(self.parked)))]
            nose_in = abs(np.sin(heading)) > 0.5
            gap = size[1] + rng.uniform(*NOSE_IN_M) if nose_in else (length + size[0]) / 2 + rng.uniform(*ALONG_M)
            u += gap * (1.0 if rng.random() < 0.5 else -1.0)
            if not 0 < u * way < config.reach_m:
                u = way * self._distance(1.9, 13.0)
        else:
            u = way * self._distance(1.6, 17.5)
            side = 1.0 if rng.random() < 0.55 else -1.0
            if rng.random() < config.nose_in:
                v = side * (half + rng.uniform(0.2, 0.8) + size[0] / 2)
                heading = float(side * np.pi / 2 * rng.choice([-1, 1]) + rng.normal(0, 0.05))
            else:
                v = side * (half - size[1] / 2 + rng.uniform(-0.2, 1.0))
                heading = (np.pi if side > 0 else 0.0) + (
                    np.pi if rng.random() < config.parked_against_traffic else 0.0
                )
        return self._at(self.parked, u, v, heading, size[0], sway=(0.08, 0.02))

    def _off_street(self, size: Floats, way: float) -> Candidate:
        """Return a pose in drives, yards and car parks, where others may be next to it."""
        rng, ground = self.rng, self.ground
        v = (1.0 if rng.random() < 0.6 else -1.0) * (ground.half_width_m + ground.pavement_m + rng.uniform(2.0, 22.0))
        heading = float(rng.choice(QUARTER_TURNS, p=[0.3, 0.3, 0.2, 0.2])) + rng.normal(0, 0.12)
        return self._at(self.parked, way * self._distance(2.0, 15.0), v, heading, size[0])

    def _half_hidden(self, way: float) -> Candidate:
        """Return a pose at some distance to the side, to be partly occluded."""
        rng, config = self.rng, self.config
        u = way * rng.uniform(*config.half_hidden_ahead_m)
        v = rng.choice([-1.0, 1.0]) * rng.uniform(*config.half_hidden_aside_m)
        heading = float(rng.choice([0.0, np.pi, np.pi / 2, -np.pi / 2], p=[0.35, 0.35, 0.15, 0.15])) + rng.normal(
            0, 0.1
        )
        return Candidate(self.ground.to_lidar(u, v, heading), half_hidden=True)

    def _moving(self, size: Floats, way: float) -> Candidate:
        """Return a pose in a lane, alone or behind or before another one."""
        rng, config, half = self.rng, self.config, self.ground.half_width_m
        if self.traffic and rng.random() < config.in_queue:
            u, v, heading, length = self.traffic[int(rng.integers(len(self.traffic)))]
            u += ((length + size[0]) / 2 + rng.gamma(2.0, 2.5) + 1.2) * rng.choice([-1.0, 1.0])
            u = min(max(u, -config.reach_m), config.reach_m)
        else:
            u = way * self._distance(1.9, 20.0)
            lanes = max(int(half // 3.1), 1)
            lane = (int(rng.integers(lanes)) + 0.5) * min(half / lanes, 3.6)
            oncoming = rng.random() < config.oncoming
            v, heading = (lane if oncoming else -lane), (np.pi if oncoming else 0.0)
        return self._at(self.traffic, u, v, heading, size[0], sway=(0.2, 0.035), going="lane")


@dataclass(frozen=True)
class SizeStatistics:
    """Label sizes in metres, each (length, width, height), and their correlations.

    Correlations are length-width, length-height, width-height.
    """

    mean: tuple[float, float, float]
    deviation: tuple[float, float, float]
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    correlation: tuple[float, float, float]

    @cached_property
    def spread(self) -> Floats:
        """(3,3) matrix from independent normal numbers to deviations, metres."""
        lw, lh, wh = self.correlation
        factor = np.linalg.cholesky(np.array([[1.0, lw, lh], [lw, 1.0, wh], [lh, wh, 1.0]]))
        return np.asarray(np.array(self.deviation)[:, None] * factor)


# Sizes in all of KITTI's training labels; bounds are the 1st and 99th percentile, narrowed where a body needs it.
SIZES = {
    "Car": SizeStatistics(
        (3.884, 1.629, 1.526), (0.426, 0.102, 0.137), (2.94, 1.36, 1.27), (4.89, 1.88, 1.97), (0.35, 0.17, 0.31)
    ),
    "Van": SizeStatistics(
        (5.078, 1.902, 2.207), (0.831, 0.173, 0.325), (3.72, 1.56, 1.71), (6.86, 2.46, 2.87), (0.65, 0.82, 0.67)
    ),
    "Truck": SizeStatistics(
        (10.11, 2.585, 3.252), (2.86, 0.217, 0.449), (5.42, 2.06, 2.32), (16.8, 2.97, 4.19), (0.41, 0.21, 0.38)
    ),
    "Tram": SizeStatistics(
        (16.1, 2.544, 3.529), (7.85, 0.215, 0.176), (9.0, 2.17, 3.17), (35.2, 2.81, 3.84), (0.02, -0.21, 0.10)
    ),
    "Misc": SizeStatistics(
        (3.58, 1.51, 1.91), (2.86, 0.67, 0.81), (1.3, 0.6, 0.9), (11.7, 2.68, 3.6), (0.74, 0.74, 0.65)
    ),
    "Pedestrian": SizeStatistics(
        (0.842, 0.660, 1.761), (0.235, 0.143, 0.113), (0.35, 0.38, 1.10), (1.32, 0.96, 1.97), (0.20, 0.27, 0.13)
    ),
    "Cyclist": SizeStatistics(
        (1.764, 0.597, 1.737), (0.177, 0.124, 0.095), (1.30, 0.36, 1.44), (2.12, 0.88, 1.97), (0.32, 0.37, 0.13)
    ),
    "Person_sitting": SizeStatistics(
        (0.802, 0.595, 1.275), (0.222, 0.079, 0.110), (0.52, 0.48, 1.06), (1.33, 0.75, 1.64), (-0.33, 0.18, 0.33)
    ),
}
CHILD_SHARE = 0.07
MICROCAR_SHARE = 0.02  # two-seaters, which the other cars' spread does not reach
MOTORCYCLE_SHARE = 0.2  # of Misc, whose smallest quarter is two-wheelers


def draw_size(rng: np.random.Generator, name: str) -> Floats:
    """Draw (3,) length, width, height of a label box, metres."""
    if name == "Misc" and rng.random() < MOTORCYCLE_SHARE:
        return rng.uniform((1.7, 0.60, 1.45), (2.3, 0.90, 1.85))
    if name == "Car" and rng.random() < MICROCAR_SHARE:
        return rng.uniform((2.30, 1.45, 1.45), (2.95, 1.62, 1.60))
    statistics = SIZES[name]
    size = np.array(statistics.mean) + statistics.spread @ rng.standard_normal(3)
    size = np.clip(size, statistics.low, statistics.high)
    if name == "Pedestrian" and rng.random() < CHILD_SHARE:
        size *= rng.uniform(0.62, 0.85)
    return np.asarray(size)


@dataclass
class Occupied:
    """Occupied footprints, extended as objects are placed.

    Rows are x, y, length, width, yaw, and the allowed overlap with others that allow one.
    """

    rows: Floats = field(default_factory=lambda: np.zeros((2048, 6)))
    count: int = 0

    def take(
        self, x: float, y: float, length: float, width: float, yaw: float, margin_m: float = 0.0, overlap_m: float = 0.0
    ) -> bool:
        """Take a footprint if it is free with a margin around it; whether it was.

        Two footprints may overlap by the lesser `overlap_m` of theirs.
        """
        # Plain floats, so that one compiled version serves every caller.
        sides = float(length + 2 * margin_m), float(width + 2 * margin_m)
        wish = (float(x), float(y), *sides, float(yaw), float(overlap_m))
        if self.count == len(self.rows) or not _is_free(wish, self.rows, self.count):
            return False
        self.rows[self.count] = x, y, length, width, yaw, overlap_m
        self.count += 1
        return True

    def hold(self, x: float, y: float, length: float, width: float, yaw: float) -> None:
        """Occupy a footprint, free or not, for a moving object; later objects are placed outside."""
        if self.count == len(self.rows):
            self.rows = np.concatenate([self.rows, np.zeros_like(self.rows)])
        self.rows[self.count] = x, y, length, width, yaw, 0.0
        self.count += 1


@cached()
def _is_free(row: tuple[float, float, float, float, float, float], rows: Floats, count: int) -> bool:
    """Return whether a footprint overlaps none of the first `count` (separating axes of two rectangles)."""
    footprint = (row[2], row[3], row[4])
    for i in range(count):
        taken = (rows[i, 2], rows[i, 3], rows[i, 4])
        dx, dy = rows[i, 0] - row[0], rows[i, 1] - row[1]
        if max(abs(dx), abs(dy)) > (footprint[0] + footprint[1] + taken[0] + taken[1]) / 2:
            continue  # farther apart than half the diagonals
        apart = False
        overlap = min(row[5], rows[i, 5])
        for one, other in ((footprint, taken), (taken, footprint)):
            cos, sin = np.cos(one[2]), np.sin(one[2])
            c, s = abs(np.cos(other[2] - one[2])), abs(np.sin(other[2] - one[2]))
            along, across = abs(dx * cos + dy * sin), abs(dy * cos - dx * sin)
            if (
                along > (one[0] + other[0] * c + other[1] * s) / 2 - overlap
                or across > (one[1] + other[0] * s + other[1] * c) / 2 - overlap
            ):
                apart = True
        if not apart:
            return False
    return True


ON_FOOT = ("Pedestrian", "Person_sitting")
TRIES = 14
MARGIN_M = {"Pedestrian": 0.02, "Person_sitting": 0.04, "Cyclist": 0.10}
VEHICLE_MARGIN_M = 0.25
PEDESTRIANS_OVERLAP_M = 0.15  # boxes of people walking side by side overlap by that


@dataclass(frozen=True)
class Target:
    """Labelled object: KITTI type and label box (x, y, z, length, width, height, yaw).

    The body is on the ground, `lift_m` below the bottom of the box. `going` is its motion, `walked_m` the distance it
    has walked since it was placed.
    """

    type: str
    box: Floats
    lift_m: float = 0.0
    going: MotionKind = "still"
    walked_m: float = 0.0


@dataclass
class Placer:
    """Placement of the objects of one scene on its street."""

    rng: np.random.Generator
    config: SceneConfig
    ground: Ground
    occupied: Occupied
    kind: str
    targets: list[Target] = field(default_factory=list)
    half_hidden: list[Target] = field(default_factory=list)  # those of `targets` to be partly occluded

    def __post_init__(self) -> None:
        self.habits = Habits(self.rng, self.config, self.ground, self.kind)

    def place(self, name: str, ahead: bool) -> None:
        """Place one object of a class, or give up after some tries."""
        habits = self.habits
        draw: Callable[[Floats, float], Candidate] = {
            "Pedestrian": habits.pedestrian,
            "Person_sitting": habits.sitting,
            "Cyclist": habits.cyclist,
            "Tram": habits.tram,
        }.get(name, habits.vehicle)
        size = draw_size(self.rng, name)
        for _ in range(TRIES):
            candidate = draw(size, 1.0 if ahead else -1.0)
            if self._put(name, size, candidate):
                if candidate.company is not None and candidate.neighbor is not None:
                    candidate.company.append(candidate.neighbor)
                if candidate.half_hidden:
                    self.half_hidden.append(self.targets[-1])
                return

    def place_beyond(self) -> None:
        """Place a car ahead that is beyond the sensor's range but visible to the camera."""
        size = draw_size(self.rng, "Car")
        lane = self.rng.uniform(-1.2, 1.2) * (self.ground.half_width_m + 2.0)
        heading = self.rng.choice([0.0, np.pi])
        self._put("Car", size, Candidate(self.ground.to_lidar(self.rng.uniform(80.5, 115.0), lane, heading)))

    def _put(self, name: str, size: Floats, candidate: Candidate) -> bool:
        x, y, yaw = candidate.place
        level = float(self.ground.heights((x, y))[0])
        near, per_m = self.config.level_band_m
        rise = self.config.slope_x[0] * x + self.config.slope_y[0] * y
        if abs(level - self.ground.z_m - rise) > near + per_m * np.hypot(x, y):
            return False
        overlap = PEDESTRIANS_OVERLAP_M if name == "Pedestrian" else 0.0
        if not self.occupied.take(x, y, size[0], size[1], yaw, MARGIN_M.get(name, VEHICLE_MARGIN_M), overlap):
            return False
        mean, deviation = self.config.box_lift_m[0 if name in (*ON_FOOT, "Cyclist") else 1]
        lift = float(np.clip(self.rng.normal(mean, deviation), -0.12, 0.15))
        yaw = (yaw + np.pi) % (2 * np.pi) - np.pi
        box = np.array([x, y, level + lift + size[2] / 2, *size, yaw])
        self.targets.append(Target(name, box, lift, candidate.going))
        return True
