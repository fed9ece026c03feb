"""Putting labelled objects on their street, none in another."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from asca_pillars.sim.scene_config import SceneConfig
from asca_pillars.sim.world.ground import Ground
from asca_pillars.sim.world.habits import Candidate, Floats, Going, Habits
from asca_pillars.sim.world.occupied import Occupied
from asca_pillars.sim.world.sizes import draw_size

ON_FOOT = ("Pedestrian", "Person_sitting")
TRIES = 14
MARGIN_M = {"Pedestrian": 0.02, "Person_sitting": 0.04, "Cyclist": 0.10}
VEHICLE_MARGIN_M = 0.25
PEDESTRIANS_OVERLAP_M = 0.15  # boxes of people who walk side by side share that much


@dataclass(frozen=True)
class Target:
    """A labelled object: KITTI type and label box (x, y, z, length, width, height, yaw).

    The body stands on the ground, `lift_m` below the bottom of the box. `going` is what it does, `walked_m` how far it
    has walked since it was placed.
    """

    type: str
    box: Floats
    lift_m: float = 0.0
    going: Going = "still"
    walked_m: float = 0.0


@dataclass
class Placer:
    """Puts the objects of one scene on its street."""

    rng: np.random.Generator
    config: SceneConfig
    ground: Ground
    occupied: Occupied
    kind: str
    targets: list[Target] = field(default_factory=list)
    half_hidden: list[Target] = field(default_factory=list)  # those of `targets` before which something shall stand

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
        """Place a car ahead that is out of the sensor's reach but not out of the camera's sight."""
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
