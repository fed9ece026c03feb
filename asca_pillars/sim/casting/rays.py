"""What the compiled casters share: the rays of a scan, and the nearest hit of each so far.

numba reads named tuples by name. Compiled code is cached per file, and numba does not notice a change of another file:
delete the __pycache__ folders after a change of a field here.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from asca_pillars.sim.sensor.lidar import Firings

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
NOTHING = -3  # owner of a firing that met nothing
_BEYOND_RAD = 0.02  # columns are cast a little beyond the wedge: ring phases turn them by up to one firing


class RayLimits(NamedTuple):
    """What tells which rays can meet a body. It is small: numba copies whole tuples from function to function."""

    slope: Floats  # (K,) tan(elevation), falling
    lowest_origin_m: float
    highest_origin_m: float
    counts: int  # of the encoder, per revolution
    wedge_slope: float  # what is cast lies within |y| <= wedge_slope * x; 0 for all around


class Rays(NamedTuple):
    """The firings of K rings and C columns; ray (k, c) leaves (0, 0, origin_z_m[k]) towards column azimuth + phase."""

    slope: Floats  # (K,) tan(elevation), falling
    stretch: Floats  # (K,) length of a ray per metre of horizontal distance
    origin_z_m: Floats  # (K,)
    phase_counts: Floats  # (K,) in counts of the encoder
    cos_phase: Floats  # (K,)
    sin_phase: Floats  # (K,)
    cos_azimuth: Floats  # (C,)
    sin_azimuth: Floats  # (C,)
    first_column: npt.NDArray[np.int64]  # (counts + 1,) first column at or after an encoder count
    number: npt.NDArray[np.int64]  # (C,) of each column within the whole revolution
    columns_per_turn: int
    outside: Bools  # (K,C) rays of which it is asked only whether they meet an object
    counted: Bools  # (C,) columns that count for `NearestHits.alone`
    limits: RayLimits


class NearestHits(NamedTuple):
    """What each ray met first so far, (K,C), written by the casters."""

    rho_m: Floats  # horizontal distance; inf for nothing
    cosine: npt.NDArray[np.float32]  # of the angle of incidence
    reflectance: npt.NDArray[np.float32]
    owner: npt.NDArray[np.int32]
    stamp: npt.NDArray[np.int32]  # the object for which the ray was last counted in `alone`
    alone: npt.NDArray[np.int64]  # (objects,) counted rays that an object would stop if it stood alone


def rays_of(firings: Firings) -> Rays:
    """The rays of a scan's firings."""
    counts = len(firings.first_column) - 1
    cast_rad = np.abs(np.arctan2(np.sin(firings.azimuth_rad), np.cos(firings.azimuth_rad)))
    half_rad = float(cast_rad.max(initial=0.0)) + _BEYOND_RAD
    return Rays(
        slope=firings.slope,
        stretch=np.sqrt(1.0 + firings.slope**2),
        origin_z_m=firings.origin_z_m,
        phase_counts=firings.phase_rad * (counts / (2.0 * np.pi)),
        cos_phase=np.cos(firings.phase_rad),
        sin_phase=np.sin(firings.phase_rad),
        cos_azimuth=np.cos(firings.azimuth_rad),
        sin_azimuth=np.sin(firings.azimuth_rad),
        first_column=firings.first_column,
        number=firings.number,
        columns_per_turn=firings.columns_per_turn,
        outside=firings.outside,
        counted=firings.counted,
        limits=RayLimits(
            slope=firings.slope,
            lowest_origin_m=float(firings.origin_z_m.min()),
            highest_origin_m=float(firings.origin_z_m.max()),
            counts=counts,
            wedge_slope=float(np.tan(half_rad)) if half_rad < 1.5 else 0.0,
        ),
    )


def no_hits(firings: Firings, objects: int) -> NearestHits:
    """Buffers for a scan that has met nothing yet."""
    shape = (len(firings.slope), len(firings.azimuth_rad))
    return NearestHits(
        rho_m=np.full(shape, np.inf),
        cosine=np.zeros(shape, np.float32),
        reflectance=np.zeros(shape, np.float32),
        owner=np.full(shape, NOTHING, np.int32),
        stamp=np.full(shape, -1, np.int32),
        alone=np.zeros(objects, np.int64),
    )
