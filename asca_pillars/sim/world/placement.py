"""Where labelled objects stand: places by the habits of each class, none overlapping."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numba
import numpy as np
import numpy.typing as npt

from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.world.ground import Ground
from asca_pillars.sim.world.sizes import draw_size

Floats = npt.NDArray[np.float64]
Place = tuple[float, float, float]  # x, y, heading in the LiDAR frame


@dataclass(frozen=True)
class Target:
    """A labelled object: KITTI type and label box (x, y, z, length, width, height, yaw). The body stands on the
    ground, `lift_m` below the bottom of the box."""

    type: str
    box: Floats
    lift_m: float = 0.0


@dataclass
class Occupied:
    """Footprints that are taken: rows x, y, length, width, yaw. Grows as things are placed."""

    rows: Floats = field(default_factory=lambda: np.zeros((1024, 5)))
    count: int = 0

    def take(self, x: float, y: float, length: float, width: float, yaw: float, margin_m: float = 0.0) -> bool:
        """Take a footprint if it is free with a margin around it; whether it was."""
        row = np.array([x, y, length + 2 * margin_m, width + 2 * margin_m, yaw])
        if not _is_free(row, self.rows, self.count) or self.count == len(self.rows):
            return False
        row[2:4] -= 2 * margin_m
        self.rows[self.count] = row
        self.count += 1
        return True


@numba.njit(cache=True)
def _is_free(row: Floats, rows: Floats, count: int) -> bool:
    """Whether a footprint overlaps none of the first `count` (separating axes of two rectangles)."""
    for i in range(count):
        dx, dy = rows[i, 0] - row[0], rows[i, 1] - row[1]
        if max(abs(dx), abs(dy)) > (row[2] + row[3] + rows[i, 2] + rows[i, 3]) / 2:
            continue  # farther than half the diagonals reach
        apart = False
        for one, other in ((row, rows[i]), (rows[i], row)):
            cos, sin = np.cos(one[4]), np.sin(one[4])
            c, s = abs(np.cos(other[4] - one[4])), abs(np.sin(other[4] - one[4]))
            along, across = abs(dx * cos + dy * sin), abs(dy * cos - dx * sin)
            if (
                along > (one[2] + other[2] * c + other[3] * s) / 2
                or across > (one[3] + other[2] * s + other[3] * c) / 2
            ):
                apart = True
        if not apart:
            return False
    return True


@dataclass
class Placer:
    """Puts the objects of one scene on its street."""

    rng: np.random.Generator
    config: SceneConfig
    ground: Ground
    occupied: Occupied
    kind: str
    targets: list[Target] = field(default_factory=list)
    _rows: list[tuple[float, float, float, float]] = field(default_factory=list)  # parked: u, v, heading, length
    _traffic: list[tuple[float, float, float, float]] = field(default_factory=list)  # moving: the same
    _groups: list[tuple[float, float, float]] = field(default_factory=list)  # people: u, v, heading
    _riders: list[tuple[float, float, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        ground, rng = self.ground, self.rng
        # Zebra crossings lie where roads meet, or anywhere.
        at_junction = ground.cross_half_m > 0 and rng.random() < 0.6
        beside = ground.cross_u_m - rng.choice([-1.0, 1.0]) * (ground.cross_half_m + 2.5)
        self._zebra_u = float(beside if at_junction else rng.uniform(6.0, 45.0))

    def place(self, name: str, ahead: bool) -> None:
        """Place one object of a class, or give up after some tries."""
        pick: Callable[[Floats, float], Place] = {
            "Pedestrian": self._pedestrian, "Person_sitting": self._sitting, "Cyclist": self._cyclist,
            "Tram": self._tram,
        }.get(name, self._vehicle)  # fmt: skip
        size = draw_size(self.rng, name)
        on_foot = name in ("Pedestrian", "Person_sitting")
        margin = 0.04 if on_foot else 0.10 if name == "Cyclist" else 0.25
        for _ in range(14):
            if self._put(name, size, pick(size, 1.0 if ahead else -1.0), margin):
                return

    def place_beyond(self) -> None:
        """Place a car ahead that is out of the sensor's reach but not out of the camera's sight."""
        size = draw_size(self.rng, "Car")
        lane = self.rng.uniform(-1.2, 1.2) * (self.ground.half_width_m + 2.0)
        heading = self.rng.choice([0.0, np.pi])
        self._put("Car", size, self.ground.to_lidar(self.rng.uniform(80.5, 115.0), lane, heading), 0.25)

    def _put(self, name: str, size: Floats, place: Place, margin_m: float) -> bool:
        x, y, yaw = place
        level = float(self.ground.heights((x, y))[0])
        near, per_m = self.config.level_band_m
        rise = self.config.slope_x[0] * x + self.config.slope_y[0] * y
        if abs(level - self.ground.z_m - rise) > near + per_m * np.hypot(x, y):
            return False
        if not self.occupied.take(x, y, size[0], size[1], yaw, margin_m):
            return False
        mean, deviation = self.config.box_lift_m[0 if name in ("Pedestrian", "Person_sitting", "Cyclist") else 1]
        lift = float(np.clip(self.rng.normal(mean, deviation), -0.12, 0.15))
        yaw = (yaw + np.pi) % (2 * np.pi) - np.pi
        self.targets.append(Target(name, np.array([x, y, level + lift + size[2] / 2, *size, yaw]), lift))
        return True

    def _distance(self, shape: float, scale: float) -> float:
        distance = float(self.rng.gamma(shape, scale))
        return distance if 2.0 < distance < self.config.reach_m else float(self.rng.uniform(2.0, self.config.reach_m))

    def _vehicle(self, size: Floats, way: float) -> Place:
        long = size[0] > 6.0
        habit = self.rng.random()
        parked = {"residential": 0.64, "urban": 0.44, "rural": 0.14, "campus": 0.47}[self.kind] * (0.3 if long else 1.0)
        if self.ground.cross_half_m > 0 and habit > 0.88:
            return self._crossing()
        if habit < parked:
            return self._parked(size, way)
        if habit < parked + 0.18:
            return self._off_street(way)
        return self._moving(size, way)

    def _crossing(self) -> Place:
        """On the crossing road, where traffic keeps to its right too."""
        rng, ground = self.rng, self.ground
        lane = -1.0 if rng.random() < 0.5 else 1.0
        across = lane * ground.cross_half_m * rng.uniform(0.4, 0.65)
        heading = (0.0 if lane > 0 else np.pi) + rng.normal(0, 0.06)
        return ground.cross_to_lidar(rng.uniform(-45.0, 45.0), across, heading)

    def _parked(self, size: Floats, way: float) -> Place:
        """At the kerb, half on the pavement or nose in; mostly next to one that is parked already."""
        rng, half = self.rng, self.ground.half_width_m
        row = self._rows[int(rng.integers(len(self._rows)))] if self._rows and rng.random() < 0.65 else None
        if row is not None:
            u, v, heading, length = row
            nose_in = abs(np.sin(heading)) > 0.5
            gap = size[1] + rng.uniform(0.5, 1.1) if nose_in else (length + size[0]) / 2 + rng.uniform(0.4, 1.8)
            u += gap * (1.0 if rng.random() < 0.5 else -1.0)
            if not 0 < u * way < self.config.reach_m:
                u = way * self._distance(1.9, 13.0)
        else:
            u = way * self._distance(1.6, 17.5)
            side = 1.0 if rng.random() < 0.55 else -1.0
            if rng.random() < 0.15:
                v = side * (half + rng.uniform(0.2, 0.8) + size[0] / 2)
                heading = float(side * np.pi / 2 * rng.choice([-1, 1]) + rng.normal(0, 0.05))
            else:
                v = side * (half - size[1] / 2 + rng.uniform(-0.2, 1.0))
                heading = (np.pi if side > 0 else 0.0) + (np.pi if rng.random() < 0.2 else 0.0)
        self._rows.append((u, v, heading, float(size[0])))
        return self.ground.to_lidar(u, v + rng.normal(0, 0.08), heading + rng.normal(0, 0.02))

    def _off_street(self, way: float) -> Place:
        """In drives, yards and car parks."""
        rng, ground = self.rng, self.ground
        v = (1.0 if rng.random() < 0.6 else -1.0) * (ground.half_width_m + ground.pavement_m + rng.uniform(2.0, 22.0))
        heading = float(rng.choice([0.0, np.pi, np.pi / 2, -np.pi / 2], p=[0.3, 0.3, 0.2, 0.2])) + rng.normal(0, 0.12)
        return ground.to_lidar(way * self._distance(2.0, 15.0), v, heading)

    def _moving(self, size: Floats, way: float) -> Place:
        """In a lane, alone or behind or before another one."""
        rng, half = self.rng, self.ground.half_width_m
        if self._traffic and rng.random() < 0.3:  # a queue
            u, v, heading, length = self._traffic[int(rng.integers(len(self._traffic)))]
            u += ((length + size[0]) / 2 + rng.gamma(2.0, 2.5) + 1.2) * rng.choice([-1.0, 1.0])
            u = min(max(u, -self.config.reach_m), self.config.reach_m)
        else:
            u = way * self._distance(1.9, 20.0)
            lanes = max(int(half // 3.1), 1)
            lane = (int(rng.integers(lanes)) + 0.5) * min(half / lanes, 3.6)
            oncoming = rng.random() < 0.45
            v, heading = (lane if oncoming else -lane), (np.pi if oncoming else 0.0)
        self._traffic.append((u, v, heading, float(size[0])))
        return self.ground.to_lidar(u, v + rng.normal(0, 0.2), heading + rng.normal(0, 0.035))

    def _tram(self, size: Floats, way: float) -> Place:
        rails = self.ground.rails_v_m
        v = self.ground.half_width_m + 3.0 if rails is None else rails
        return self.ground.to_lidar(way * self.rng.uniform(8.0, 74.0), v, self.rng.choice([0.0, np.pi]))

    def _pedestrian(self, size: Floats, way: float) -> Place:
        rng, ground = self.rng, self.ground
        half, pavement = ground.half_width_m, ground.pavement_m
        if self._groups and rng.random() < 0.42:
            u, v, heading = self._companion(self._groups[int(rng.integers(len(self._groups)))])
        else:
            u = way * self._distance(2.0, 6.6)
            place = rng.random()
            across = rng.random() < 0.25
            if place < 0.10 and way > 0:
                u, v, across = self._zebra_u + rng.uniform(-1.5, 1.5), rng.uniform(-half - 1.0, half + 1.0), True
            elif self.kind == "campus" and place < 0.6:
                v = rng.uniform(-12.0, 12.0)
            elif place < 0.2:
                v = rng.uniform(-half, half)
            else:
                v = (1.0 if rng.random() < 0.5 else -1.0) * (half + rng.uniform(0.1, max(pavement, 1.0) + 1.5))
            heading = (np.pi / 2 if across else 0.0) + rng.choice([0.0, np.pi]) + rng.normal(0, 0.15)
            if rng.random() < self.config.pedestrian_uniform_heading:
                heading = rng.uniform(-np.pi, np.pi)
        self._groups.append((u, v, float(heading)))
        return ground.to_lidar(u, v, float(heading))

    def _companion(self, of: tuple[float, float, float]) -> tuple[float, float, float]:
        """Beside somebody with the same heading, behind, or face to face."""
        rng = self.rng
        u, v, heading = of
        habit = rng.random()
        if habit < 0.5:
            along, across, turn = rng.normal(0, 0.15), rng.choice([-1, 1]) * rng.uniform(0.5, 0.9), rng.normal(0, 0.12)
        elif habit < 0.75:
            along, across = rng.choice([-1, 1]) * rng.uniform(0.8, 2.2), rng.normal(0, 0.5)
            turn = rng.normal(0, 0.2)
        else:
            along, across, turn = rng.uniform(0.6, 1.2), rng.normal(0, 0.3), np.pi + rng.normal(0, 0.5)
        cos, sin = np.cos(heading), np.sin(heading)
        return float(u + along * cos - across * sin), float(v + along * sin + across * cos), float(heading + turn)

    def _sitting(self, size: Floats, way: float) -> Place:
        rng, ground = self.rng, self.ground
        if self._groups and rng.random() < 0.4:  # at a table
            u, v, _ = self._groups[int(rng.integers(len(self._groups)))]
            u, v = u + rng.normal(0, 1.0), v + rng.normal(0, 1.0)
        else:
            u = way * self._distance(2.5, 4.2)
            v = ground.half_width_m + rng.uniform(0.6, max(ground.pavement_m, 1.0) + 2.0)
            v *= 1.0 if rng.random() < 0.5 else -1.0
        self._groups.append((u, v, 0.0))
        return ground.to_lidar(u, v, rng.uniform(-np.pi, np.pi))

    def _cyclist(self, size: Floats, way: float) -> Place:
        rng, half = self.rng, self.ground.half_width_m
        if self._riders and rng.random() < 0.2:  # side by side, or one behind the other
            u, v, heading = self._riders[int(rng.integers(len(self._riders)))]
            beside = rng.random() < 0.4
            u += rng.normal(0, 0.4) if beside else rng.choice([-1, 1]) * rng.uniform(2.2, 6.0)
            v += rng.choice([-1, 1]) * rng.uniform(0.8, 1.3) if beside else rng.normal(0, 0.3)
        elif rng.random() < self.config.cyclist_crossing:
            u, v = way * self._distance(2.0, 12.5), rng.uniform(-half - 4.0, half + 4.0)
            heading = float(rng.choice([-1, 1]) * np.pi / 2 + rng.normal(0, 0.45))
        else:
            u = way * self._distance(2.0, 12.5)
            side = -1.0 if rng.random() < 0.6 else 1.0
            v = side * (half + (rng.uniform(-1.3, -0.3) if rng.random() < 0.5 else rng.uniform(0.4, 7.0)))
            heading = (np.pi if (side > 0) != (rng.random() < 0.3) else 0.0) + rng.normal(0, 0.12)
        self._riders.append((u, v, heading))
        return self.ground.to_lidar(u, v, heading)
