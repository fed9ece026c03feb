"""Labelled objects on their street: sizes by KITTI's statistics, and free positions."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from asca_pillars.base.compiling import cached
from asca_pillars.geometry.arrays import Floats
from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.world.ground import Ground
from asca_pillars.sim.world.habits import Candidate, Habits, MotionKind


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
    own = (row[2], row[3], row[4])
    for i in range(count):
        taken = (rows[i, 2], rows[i, 3], rows[i, 4])
        dx, dy = rows[i, 0] - row[0], rows[i, 1] - row[1]
        if max(abs(dx), abs(dy)) > (own[0] + own[1] + taken[0] + taken[1]) / 2:
            continue  # farther apart than half the diagonals
        apart = False
        overlap = min(row[5], rows[i, 5])
        for one, other in ((own, taken), (taken, own)):
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
