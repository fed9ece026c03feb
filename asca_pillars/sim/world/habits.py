"""Positions of road users of each class on a street, standing or moving; u along it, v to its left."""

from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from asca_pillars.geometry.arrays import Floats
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
        beside = ground.cross_u_m - rng.choice([-1.0, 1.0]) * (ground.cross_half_m + 2.5)
        anywhere = float(rng.uniform(6.0, 45.0))
        self.zebra_u = (
            float(beside) if at_junction and beside > 0 else anywhere,
            float(beside) if at_junction and beside < 0 else -anywhere,
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
            beside = rng.random() < 0.4
            u += rng.normal(0, 0.4) if beside else rng.choice([-1, 1]) * rng.uniform(2.2, 6.0)
            v += rng.choice([-1, 1]) * rng.uniform(0.8, 1.3) if beside else rng.normal(0, 0.3)
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
