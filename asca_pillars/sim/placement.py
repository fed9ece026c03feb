"""Where labelled objects stand: sizes by KITTI's statistics, places by the habits of each class, none overlapping."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numba
import numpy as np
import numpy.typing as npt

from .config import SceneConfig
from .ground import Ground

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class SizeStatistics:
    """Label sizes in metres, each (length, width, height), and the correlations length-width, length-height,
    width-height."""

    mean: tuple[float, float, float]
    deviation: tuple[float, float, float]
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    correlation: tuple[float, float, float]

    @cached_property
    def spread(self) -> Floats:
        """(3,3) turning independent normal numbers into deviations, metres."""
        lw, lh, wh = self.correlation
        factor = np.linalg.cholesky(np.array([[1.0, lw, lh], [lw, 1.0, wh], [lh, wh, 1.0]]))
        return np.asarray(np.array(self.deviation)[:, None] * factor)


# Of all of KITTI's training labels; the bounds are the 1st and 99th percentile, narrowed where a body needs it.
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


@dataclass(frozen=True)
class Target:
    """A labelled object: KITTI type and label box (x, y, z, length, width, height, yaw)."""

    type: str
    box: Floats


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


def draw_size(rng: np.random.Generator, name: str) -> Floats:
    """Length, width, height of a label box, metres."""
    statistics = SIZES[name]
    size = np.array(statistics.mean) + statistics.spread @ rng.standard_normal(3)
    size = np.clip(size, statistics.low, statistics.high)
    if name == "Pedestrian" and rng.random() < CHILD_SHARE:
        size *= rng.uniform(0.62, 0.85)
    return np.asarray(size)


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
    _groups: list[tuple[float, float, float]] = field(default_factory=list)  # people: u, v, heading

    def place(self, name: str, ahead: bool) -> None:
        """Place one object of a class, or give up after some tries."""
        pick: Callable[[Floats, float], tuple[float, float, float]] = {
            "Pedestrian": self._pedestrian, "Person_sitting": self._sitting, "Cyclist": self._cyclist,
            "Tram": self._tram,
        }.get(name, self._vehicle)  # fmt: skip
        size = draw_size(self.rng, name)
        margin = 0.12 if name in ("Pedestrian", "Person_sitting", "Cyclist") else 0.25
        for _ in range(14):
            x, y, yaw = pick(size, 1.0 if ahead else -1.0)
            if not self.occupied.take(x, y, size[0], size[1], yaw, margin):
                continue
            z = float(self.ground.heights((x, y))[0])
            yaw = (yaw + np.pi) % (2 * np.pi) - np.pi
            self.targets.append(Target(name, np.array([x, y, z + size[2] / 2, *size, yaw])))
            return

    def _distance(self, shape: float, scale: float) -> float:
        distance = float(self.rng.gamma(shape, scale))
        return distance if 2.5 < distance < self.config.reach_m else float(self.rng.uniform(2.5, self.config.reach_m))

    def _vehicle(self, size: Floats, way: float) -> tuple[float, float, float]:
        rng, ground = self.rng, self.ground
        half = ground.half_width_m
        long = size[0] > 6.0
        habit = rng.random()
        parked = {"residential": 0.62, "urban": 0.42, "rural": 0.12, "campus": 0.45}[self.kind] * (0.3 if long else 1.0)
        if ground.cross_half_m > 0 and habit > 0.84:
            along = rng.uniform(-45.0, 45.0)
            lane = -1.0 if rng.random() < 0.5 else 1.0
            # On the crossing road, traffic keeps to its right too.
            across = lane * ground.cross_half_m * rng.uniform(0.4, 0.65)
            return ground.cross_to_lidar(along, across, (0.0 if lane > 0 else np.pi) + rng.normal(0, 0.06))
        if habit < parked:
            if self._rows and rng.random() < 0.6:
                u, v, heading, length = self._rows[int(rng.integers(len(self._rows)))]
                gap = (length + size[0]) / 2 + rng.uniform(0.4, 2.2)
                turned = abs(np.sin(heading)) > 0.5
                if turned:
                    gap = size[1] + rng.uniform(0.5, 1.1)
                u += gap * (1.0 if rng.random() < 0.5 else -1.0)
                if not 0 < u * way < self.config.reach_m:
                    u = way * self._distance(1.9, 13.0)
            else:
                u = way * self._distance(1.7, 15.0)
                side = 1.0 if rng.random() < 0.55 else -1.0
                turned = rng.random() < 0.18
                if turned:
                    v = side * (half + rng.uniform(0.2, 0.8) + size[0] / 2)
                    heading = side * np.pi / 2 * rng.choice([-1, 1]) + rng.normal(0, 0.05) * 1.0
                else:
                    v = side * (half - size[1] / 2 + rng.uniform(-0.2, 1.0))
                    heading = (np.pi if side > 0 else 0.0) + (np.pi if rng.random() < 0.15 else 0.0)
            self._rows.append((u, v, heading, float(size[0])))
            return ground.to_lidar(u, v + rng.normal(0, 0.08), heading + rng.normal(0, 0.02))
        if habit < parked + 0.14:  # drives, yards, car parks
            u = way * self._distance(2.0, 15.0)
            v = (1.0 if rng.random() < 0.6 else -1.0) * (half + ground.pavement_m + rng.uniform(2.0, 16.0))
            heading = rng.choice([0.0, np.pi / 2, np.pi, -np.pi / 2]) + rng.normal(0, 0.12)
            return ground.to_lidar(u, v, float(heading))
        u = way * self._distance(2.0, 17.0)
        lanes = max(int(half // 3.1), 1)
        lane = (int(rng.integers(lanes)) + 0.5) * min(half / lanes, 3.6)
        oncoming = rng.random() < 0.5
        v = (lane if oncoming else -lane) + rng.normal(0, 0.2)
        return ground.to_lidar(u, v, (np.pi if oncoming else 0.0) + rng.normal(0, 0.035))

    def _tram(self, size: Floats, way: float) -> tuple[float, float, float]:
        rails = self.ground.rails_v_m
        v = self.ground.half_width_m + 3.0 if rails is None else rails
        return self.ground.to_lidar(way * self.rng.uniform(8.0, 74.0), v, self.rng.choice([0.0, np.pi]))

    def _pedestrian(self, size: Floats, way: float) -> tuple[float, float, float]:
        rng, ground = self.rng, self.ground
        half, pavement = ground.half_width_m, ground.pavement_m
        if self._groups and rng.random() < 0.35:  # company
            u, v, heading = self._groups[int(rng.integers(len(self._groups)))]
            u, v = u + rng.normal(0, 0.7), v + rng.normal(0, 0.7)
            heading = heading if rng.random() < 0.6 else rng.uniform(-np.pi, np.pi)
        else:
            u = way * self._distance(2.0, 7.5)
            place = rng.random()
            if self.kind == "campus" and place < 0.6:
                v = rng.uniform(-12.0, 12.0)
            elif place < 0.2:
                v = rng.uniform(-half, half)
            else:
                v = (1.0 if rng.random() < 0.5 else -1.0) * (half + rng.uniform(0.2, max(pavement, 1.0) + 1.5))
            along = 0.0 if rng.random() < 0.75 else np.pi / 2
            heading = along + rng.choice([0.0, np.pi]) + rng.normal(0, 0.15)
            if rng.random() < self.config.pedestrian_uniform_heading:
                heading = rng.uniform(-np.pi, np.pi)
        self._groups.append((u, v, float(heading)))
        return ground.to_lidar(u, v, float(heading))

    def _sitting(self, size: Floats, way: float) -> tuple[float, float, float]:
        v = self.ground.half_width_m + self.rng.uniform(0.8, max(self.ground.pavement_m, 1.0) + 3.0)
        v *= 1.0 if self.rng.random() < 0.5 else -1.0
        return self.ground.to_lidar(way * self._distance(2.5, 5.0), v, self.rng.uniform(-np.pi, np.pi))

    def _cyclist(self, size: Floats, way: float) -> tuple[float, float, float]:
        rng, ground = self.rng, self.ground
        half = ground.half_width_m
        u = way * self._distance(2.2, 11.0)
        if rng.random() < self.config.cyclist_crossing:
            v = rng.uniform(-half - 4.0, half + 4.0)
            return ground.to_lidar(u, v, rng.choice([-1, 1]) * np.pi / 2 + rng.normal(0, 0.45))
        side = -1.0 if rng.random() < 0.55 else 1.0
        v = side * (half + (rng.uniform(-1.3, -0.3) if rng.random() < 0.6 else rng.uniform(0.4, 2.5)))
        against = rng.random() < 0.15
        return ground.to_lidar(u, v, (np.pi if (side > 0) != against else 0.0) + rng.normal(0, 0.12))
