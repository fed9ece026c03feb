"""Ground: a carriageway with kerbs, a crossing one, verges, banks, hills and tracks.

Road coordinates: u along the main road, v to its left, v = 0 at its middle, in metres. They are rotated and bent
relative to the LiDAR frame, in which the car is at the origin.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from asca_pillars.geometry.boxes import Floats, Mask
from asca_pillars.sim.casting import groundcast
from asca_pillars.sim.casting.groundcast import NO_RAILS, RELIEF_HALF_M, RELIEF_STEP_M, Street

LEVEL_WITHIN_M, SLOPE_LASTS_M = 28.0, 40.0
# The lattice of the relief, and the fraction of the hills there: roads are level where one drives, hills begin
# at some distance, with their crests or troughs at the car.
_AXIS_M = np.arange(-RELIEF_HALF_M, RELIEF_HALF_M + RELIEF_STEP_M / 2, RELIEF_STEP_M)
_X_M, _Y_M = np.meshgrid(_AXIS_M, _AXIS_M, indexing="ij")
_BEGUN = 1.0 - np.exp(-(_X_M**2 + _Y_M**2) / LEVEL_WITHIN_M**2)


@dataclass(frozen=True)
class Ground:
    """Ground surface of one scene.

    Attributes:
        street: carriageways, kerbs, banks and tracks.
        relief: (R,R) heights in metres on a square lattice of RELIEF_STEP_M around the car, x by rows.
        reflectance: (6,) of asphalt, pavement, verge, marking, rail, ballast.
        z_m: height of the ground under the car in the LiDAR frame.
    """

    street: Street
    relief: Floats
    reflectance: Floats
    z_m: float

    @property
    def half_width_m(self) -> float:
        """Half the width of the main road."""
        return self.street.half_width_m

    @property
    def pavement_m(self) -> float:
        """Width of the pavements."""
        return self.street.pavement_m

    @property
    def cross_u_m(self) -> float:
        """Position of the crossing road along the main road."""
        return self.street.cross_u_m

    @property
    def cross_half_m(self) -> float:
        """Half the width of the crossing road; 0 without one."""
        return self.street.cross_half_m

    @property
    def rails_v_m(self) -> float | None:
        """Middle of a track in road coordinates, of the left one of two; None without tracks."""
        v = self.street.rails_v_m
        if v <= NO_RAILS:
            return None
        return v + (groundcast.TRACK_SPACING_HALF_M if self.street.tracks > 1.0 else 0.0)

    @property
    def left_edge_m(self) -> float:
        """Start of the left side's pavement: behind the second carriageway, if there is one, and the tracks."""
        second = float(self.street.second_v_m + self.street.second_half_m)
        bed = float(self.street.rails_v_m + self.street.bed_half_m)
        return max(self.half_width_m, second, bed)

    def to_lidar(self, u_m: float, v_m: float, yaw_rad: float = 0.0) -> tuple[float, float, float]:
        """Convert road coordinates and a heading relative to the road -> x, y, heading in the LiDAR frame."""
        street = self.street
        cos, sin, bend = street.cos_yaw, street.sin_yaw, street.bend_per_m
        across = v_m + street.offset_m + 0.5 * bend * u_m * u_m
        yaw = street.yaw_rad + math.atan(bend * u_m) + yaw_rad
        return float(u_m * cos - across * sin), float(u_m * sin + across * cos), float(yaw)

    def to_road(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Convert a position in the LiDAR frame -> u, v in road coordinates."""
        street = self.street
        cos, sin = street.cos_yaw, street.sin_yaw
        u, v = x_m * cos + y_m * sin, y_m * cos - x_m * sin
        return u, v - street.offset_m - 0.5 * street.bend_per_m * u * u

    def cross_to_lidar(self, along_m: float, across_m: float, yaw_rad: float = 0.0) -> tuple[float, float, float]:
        """Convert as `to_lidar` for the crossing road: along it to the left of the main road, across it ahead."""
        street = self.street
        cos, sin = street.cos_tilt, street.sin_tilt
        u = street.cross_u_m + across_m * cos - along_m * sin
        x, y, _ = self.to_lidar(u, along_m * cos + across_m * sin)
        return x, y, float(street.yaw_rad + street.cross_tilt_rad + math.pi / 2 + yaw_rad)

    def places(self, along_m: Floats, across_m: Floats, cross: Mask) -> Floats:
        """Return `to_lidar` or, where `cross` (N,), `cross_to_lidar` of many: (N,) and (N,) -> (N,2) x and y."""
        street, u, v = self.street, along_m.copy(), across_m.copy()
        cos, sin = street.cos_tilt, street.sin_tilt
        u[cross] = street.cross_u_m + across_m[cross] * cos - along_m[cross] * sin
        v[cross] = along_m[cross] * cos + across_m[cross] * sin
        cos, sin = street.cos_yaw, street.sin_yaw
        v = v + street.offset_m + 0.5 * street.bend_per_m * u * u
        result = np.empty((len(u), 2))
        result[:, 0], result[:, 1] = u * cos - v * sin, u * sin + v * cos
        return result

    def headings(self, along_m: Floats, cross: Mask) -> Floats:
        """Return the road's heading (N,) in the LiDAR frame there."""
        street = self.street
        # NumPy's arc tangent differs from that of `to_lidar` in the last bit.
        turns = np.array([math.atan(slope) for slope in (street.bend_per_m * along_m).tolist()])
        return np.where(cross, street.yaw_rad + street.cross_tilt_rad + math.pi / 2, street.yaw_rad + turns)

    def heights(self, xy: ArrayLike) -> Floats:
        """Return the height (N,) of the ground at (N,2) in the LiDAR frame, metres."""
        points = np.asarray(xy, float).reshape(-1, 2)
        return np.asarray(groundcast.heights(points, self.street, self.relief, self.z_m))


def make_street(**numbers: float) -> Street:
    """Return a street with the named numbers; others are 0 or absent.

    Raises:
        TypeError: an unknown name.
    """
    given = dict.fromkeys(Street._fields, 0.0) | {"rails_v_m": NO_RAILS} | {k: float(v) for k, v in numbers.items()}
    yaw, tilt = given["yaw_rad"], given["cross_tilt_rad"]
    bank = max(given["bank_left"], given["bank_right"], 0.0)
    edges = given["kerb_m"] + given["rail_m"] + given["bed_m"]
    derived = {
        "cos_yaw": math.cos(yaw),
        "sin_yaw": math.sin(yaw),
        "cos_tilt": math.cos(tilt),
        "sin_tilt": math.sin(tilt),
        "rise_m": bank * groundcast.BANK_RUN_M + edges + 4.0 * given["camber"] + 0.05,
    }
    return Street(**(given | derived))


def draw_relief(
    rng: np.random.Generator,
    slope: tuple[float, float],
    amplitude_m: float,
    street: Street | None = None,
    bump_m: float = 0.0,
) -> Floats:
    """Draw the heights (R,R) of hills, metres.

    They are a plane of `slope` (x, y) that levels out far away, long waves that are level under the car, and bumps of
    standard deviation `bump_m` beyond the pavements of `street`.
    """
    x, y, begun = _X_M, _Y_M, _BEGUN
    # A slope extends over the visible street; KITTI's far ground is as high, on average, as that near the car.
    lasting = SLOPE_LASTS_M * np.tanh(_AXIS_M / SLOPE_LASTS_M)
    height: Any = slope[0] * lasting[:, None] + slope[1] * lasting[None, :]
    for wavelength in (160.0, 90.0, 45.0):
        angle = rng.uniform(0, 2 * np.pi)
        size = amplitude_m * wavelength / 120.0 * rng.normal(0.0, 0.6)
        along = (x * np.cos(angle) + y * np.sin(angle)) * 2 * np.pi / wavelength
        height = height + size * begun * (np.cos(along) - 1.0)
    if street is not None:
        outside = groundcast.outside_roads(np.stack([x.ravel(), y.ravel()], axis=-1), street).reshape(x.shape)
        # A lattice point shapes the cells around it: none of these may reach a carriageway.
        share = np.clip((outside - street.pavement_m - 1.5 * RELIEF_STEP_M) / 4.0, 0.0, 1.0)
        height = height + share * rng.normal(0.0, bump_m, x.shape)
    near = len(_AXIS_M) // 2
    return np.asarray(height - height[near, near])
