"""The ground: a carriageway with kerbs, a second one that crosses it, verges, banks, hills and tracks.

Road coordinates: u along the main road, v to its left, v = 0 at its middle, in metres. They are turned and bent
against the LiDAR frame, in which the car stands at the origin.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from asca_pillars.sim.casting import groundcast
from asca_pillars.sim.casting.groundcast import NO_RAILS, RELIEF_HALF_M, RELIEF_STEP_M

Floats = npt.NDArray[np.float64]
LEVEL_WITHIN_M, SLOPE_LASTS_M = 28.0, 40.0


@dataclass(frozen=True)
class Ground:
    """The surface under one scene.

    Attributes:
        shape: (28,) numbers of the street, as `street` writes them.
        relief: (R,R) heights in metres on a square lattice of RELIEF_STEP_M around the car, x by rows.
        reflectance: (6,) of asphalt, pavement, verge, marking, rail, ballast.
        z_m: height of the ground under the car in the LiDAR frame.
    """

    shape: Floats
    relief: Floats
    reflectance: Floats
    z_m: float

    @property
    def half_width_m(self) -> float:
        return self._numbers[groundcast.HALF_WIDTH]

    @property
    def pavement_m(self) -> float:
        return self._numbers[groundcast.WALK]

    @property
    def cross_u_m(self) -> float:
        return self._numbers[groundcast.CROSS_U]

    @property
    def cross_half_m(self) -> float:
        """Half the width of the crossing road; 0 where there is none."""
        return self._numbers[groundcast.CROSS_HALF]

    @property
    def rails_v_m(self) -> float | None:
        """Middle of a track in road coordinates, of the left one of two, if there is any."""
        v = self._numbers[groundcast.RAILS_V]
        if v <= NO_RAILS:
            return None
        return v + (groundcast.TRACK_SPACING_HALF_M if self._numbers[groundcast.TRACKS] > 1.0 else 0.0)

    @property
    def left_edge_m(self) -> float:
        """Where the left side's pavement begins: behind the second carriageway, if there is one, and the tracks."""
        second = float(self.shape[groundcast.SECOND_V] + self.shape[groundcast.SECOND_HALF])
        bed = float(self.shape[groundcast.RAILS_V] + self.shape[groundcast.BED_HALF])
        return max(self.half_width_m, second, bed)

    @cached_property
    def _numbers(self) -> list[float]:
        """The shape as plain numbers: places are asked for one by one, thousands per scene."""
        return [float(number) for number in self.shape]

    def to_lidar(self, u_m: float, v_m: float, yaw_rad: float = 0.0) -> tuple[float, float, float]:
        """Road coordinates and a heading against the road -> x, y, heading in the LiDAR frame."""
        numbers = self._numbers
        cos, sin, bend = numbers[groundcast.COS_YAW], numbers[groundcast.SIN_YAW], numbers[groundcast.BEND]
        across = v_m + numbers[groundcast.OFFSET] + 0.5 * bend * u_m * u_m
        yaw = numbers[groundcast.YAW] + math.atan(bend * u_m) + yaw_rad
        return float(u_m * cos - across * sin), float(u_m * sin + across * cos), float(yaw)

    def to_road(self, x_m: float, y_m: float) -> tuple[float, float]:
        """A place in the LiDAR frame -> u, v in road coordinates."""
        numbers = self._numbers
        cos, sin = numbers[groundcast.COS_YAW], numbers[groundcast.SIN_YAW]
        u, v = x_m * cos + y_m * sin, y_m * cos - x_m * sin
        return u, v - numbers[groundcast.OFFSET] - 0.5 * numbers[groundcast.BEND] * u * u

    def cross_to_lidar(self, along_m: float, across_m: float, yaw_rad: float = 0.0) -> tuple[float, float, float]:
        """The same for the crossing road: along it to the left of the main road, across it ahead."""
        numbers = self._numbers
        cos, sin = numbers[groundcast.COS_TILT], numbers[groundcast.SIN_TILT]
        u = numbers[groundcast.CROSS_U] + across_m * cos - along_m * sin
        x, y, _ = self.to_lidar(u, along_m * cos + across_m * sin)
        return x, y, float(numbers[groundcast.YAW] + numbers[groundcast.CROSS_TILT] + math.pi / 2 + yaw_rad)

    def places(self, along_m: Floats, across_m: Floats, cross: bool = False) -> Floats:
        """Places (N,) beside the main or the crossing road -> (N,2) x and y in the LiDAR frame."""
        u, v = along_m, across_m
        if cross:
            cos, sin = self.shape[groundcast.COS_TILT], self.shape[groundcast.SIN_TILT]
            u, v = self.shape[groundcast.CROSS_U] + across_m * cos - along_m * sin, along_m * cos + across_m * sin
        cos, sin = self.shape[groundcast.COS_YAW], self.shape[groundcast.SIN_YAW]
        v = v + self.shape[groundcast.OFFSET] + 0.5 * self.shape[groundcast.BEND] * u * u
        return np.stack([u * cos - v * sin, u * sin + v * cos], axis=-1)

    def heights(self, xy: npt.ArrayLike) -> Floats:
        """Height (N,) of the ground at (N,2) in the LiDAR frame, metres."""
        points = np.asarray(xy, float).reshape(-1, 2)
        return np.asarray(groundcast.heights(points, self.shape, self.relief, self.z_m))


def street(**numbers: float) -> Floats:
    """The `shape` of a Ground from its numbers by name (see the constants above); what is left out is 0 or absent."""
    numbers = {"rails_v_m": NO_RAILS, **numbers}
    order = (
        *("yaw_rad", "bend_per_m", "offset_m", "half_width_m", "cross_u_m", "cross_half_m", "cross_tilt_rad"),
        *("kerb_m", "pavement_m", "lane_m", "bank_left", "bank_right", "rails_v_m", "median_half_m", "rough_m"),
        *("camber", "tracks", "rail_m", "bed_m", "bed_half_m", "second_v_m", "second_half_m", "ditch_m"),
    )
    unknown = set(numbers) - set(order)
    if unknown:
        raise TypeError(f"a street has no {sorted(unknown)}")
    yaw, tilt = numbers.get("yaw_rad", 0.0), numbers.get("cross_tilt_rad", 0.0)
    bank = max(numbers.get("bank_left", 0.0), numbers.get("bank_right", 0.0), 0.0)
    edges = sum(numbers.get(name, 0.0) for name in ("kerb_m", "rail_m", "bed_m"))
    rise = bank * groundcast.BANK_RUN_M + edges + 4.0 * numbers.get("camber", 0.0) + 0.05
    derived = [np.cos(yaw), np.sin(yaw), np.cos(tilt), np.sin(tilt), rise]
    return np.array([numbers.get(name, 0.0) for name in order] + derived)


def draw_relief(
    rng: np.random.Generator,
    slope: tuple[float, float],
    amplitude_m: float,
    shape: Floats | None = None,
    bump_m: float = 0.0,
) -> Floats:
    """Hills: a plane of `slope` (x, y) that levels out far away, long waves that are level under the car, and bumps
    of standard deviation `bump_m` beyond the pavements of the street `shape`. Metres, (R,R)."""
    axis = np.arange(-RELIEF_HALF_M, RELIEF_HALF_M + RELIEF_STEP_M / 2, RELIEF_STEP_M)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    # A slope lasts as far as one sees the street; KITTI's far ground lies as high, on average, as that near the car.
    lasting = SLOPE_LASTS_M * np.tanh(axis / SLOPE_LASTS_M)
    height: Any = slope[0] * lasting[:, None] + slope[1] * lasting[None, :]
    # Roads are laid out level where one drives: hills begin some way off, with their crests or troughs at the car.
    begun = 1.0 - np.exp(-(x**2 + y**2) / LEVEL_WITHIN_M**2)
    for wavelength in (160.0, 90.0, 45.0):
        angle = rng.uniform(0, 2 * np.pi)
        size = amplitude_m * wavelength / 120.0 * rng.normal(0.0, 0.6)
        along = (x * np.cos(angle) + y * np.sin(angle)) * 2 * np.pi / wavelength
        height = height + size * begun * (np.cos(along) - 1.0)
    if shape is not None:
        outside = groundcast.outside_roads(np.stack([x.ravel(), y.ravel()], axis=-1), shape).reshape(x.shape)
        # A lattice point shapes the cells around it: none of these may reach a carriageway.
        share = np.clip((outside - shape[groundcast.WALK] - 1.5 * RELIEF_STEP_M) / 4.0, 0.0, 1.0)
        height = height + share * rng.normal(0.0, bump_m, x.shape)
    near = len(axis) // 2
    return np.asarray(height - height[near, near])
