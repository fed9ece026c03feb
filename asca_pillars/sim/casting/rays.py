"""Common parts of the compiled casters: rays of a scan, windows of rays that can hit a body, and nearest hits.

numba reads named tuples by name. Compiled code is cached per file, and numba does not detect a change of another file:
delete the __pycache__ folders after a change here.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.compiling import cached
from asca_pillars.geometry.boxes import Floats, Ints, Mask, Singles
from asca_pillars.sim.lidar import Firings

NOTHING = -3  # owner of a firing without a hit
_BEYOND_RAD = 0.02  # columns are cast slightly beyond the wedge: ring phases turn them by up to one firing


class RayLimits(NamedTuple):
    """Bounds for the selection of rays that can hit a body. Small: numba copies whole tuples between functions."""

    slope: Floats  # (K,) tan(elevation), falling
    lowest_origin_m: float
    highest_origin_m: float
    counts: int  # of the encoder, per revolution
    wedge_slope: float  # cast directions are within |y| <= wedge_slope * x; 0 for all around


class Rays(NamedTuple):
    """Firings of K rings and C columns; ray (k, c) leaves (0, 0, origin_z_m[k]) towards column azimuth + phase."""

    slope: Floats  # (K,) tan(elevation), falling
    stretch: Floats  # (K,) length of a ray per metre of horizontal distance
    origin_z_m: Floats  # (K,)
    phase_counts: Floats  # (K,) in counts of the encoder
    cos_phase: Floats  # (K,)
    sin_phase: Floats  # (K,)
    cos_azimuth: Floats  # (C,)
    sin_azimuth: Floats  # (C,)
    first_column: Ints  # (counts + 1,) first column at or after an encoder count
    number: Ints  # (C,) of each column within the whole revolution
    columns_per_turn: int
    outside: Mask  # (K,C) rays cast only for whether they hit an object
    counted: Mask  # (C,) columns that count for `NearestHits.alone`
    limits: RayLimits


class NearestHits(NamedTuple):
    """Nearest hit of each ray so far, (K,C), written by the casters."""

    rho_m: Floats  # horizontal distance; inf without a hit
    cosine: Singles  # of the angle of incidence
    reflectance: Singles
    owner: NDArray[np.int32]
    stamp: NDArray[np.int32]  # the object for which the ray was last counted in `alone`
    alone: Ints  # (objects,) counted rays that would hit an object if it stood alone


def rays_of(firings: Firings) -> Rays:
    """Return the rays of a scan's firings."""
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
    """Return empty buffers for the hits of a scan."""
    shape = (len(firings.slope), len(firings.azimuth_rad))
    return NearestHits(
        rho_m=np.full(shape, np.inf),
        cosine=np.zeros(shape, np.float32),
        reflectance=np.zeros(shape, np.float32),
        owner=np.full(shape, NOTHING, np.int32),
        stamp=np.full(shape, -1, np.int32),
        alone=np.zeros(objects, np.int64),
    )


PLAIN = {"error_model": "numpy"}  # NumPy's division, without checks for zeros
TURN = 2 * np.pi - 1e-9


class Window(NamedTuple):
    """Rings [first_ring, last_ring) and azimuths [low_counts, low_counts + width_counts] that can hit a body.

    Azimuths are in counts of the encoder, low_counts within one revolution from 0.
    """

    first_ring: int
    last_ring: int
    low_counts: float
    width_counts: float


@cached(inline="always", **PLAIN)
def ray_bits(key: int, ring: int, column: int, salt: int) -> np.uint64:
    """Return 64 random bits from a key, a ray and a salt (the finalizer of splitmix64)."""
    number = (np.uint64(salt) << np.uint64(24)) ^ np.uint64(ring * 4096 + column)
    z = np.uint64(key) + number * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@cached(inline="always", **PLAIN)
def ray_chance(key: int, ring: int, column: int, salt: int) -> float:
    """Return a uniform random number in (0, 1) of a ray and a salt."""
    return (float(ray_bits(key, ring, column, salt) >> np.uint64(11)) + 0.5) * (1.0 / 9007199254740992.0)


@cached(**PLAIN)
def ring_below(slope: Floats, limit: float) -> int:
    """Return the index of the first ring whose slope is not above `limit`; slopes (K,) descend."""
    first, last = 0, len(slope)
    while first < last:
        middle = (first + last) // 2
        if slope[middle] > limit:
            first = middle + 1
        else:
            last = middle
    return first


@cached(**PLAIN)
def rings_of(z_low: float, z_high: float, near: float, far: float, limits: RayLimits) -> tuple[int, int]:
    """Return the rings [first, last) that can hit between two heights and two horizontal distances."""
    above = z_high - limits.lowest_origin_m
    below = z_low - limits.highest_origin_m
    near = max(near, 1e-6)
    steepest = above / near if above > 0 else above / far
    shallowest = below / far if below > 0 else below / near
    first = ring_below(limits.slope, steepest)
    return first, max(ring_below(limits.slope, np.nextafter(shallowest, -np.inf)), first)


@cached(**PLAIN)
def window_of(first_ring: int, last_ring: int, low: float, width: float, limits: RayLimits) -> Window:
    """Return the window of these rings and of azimuths [low, low + width]."""
    counts = limits.counts
    per_rad = counts / (2.0 * np.pi)
    low_counts = low * per_rad
    low_counts -= counts * np.floor(low_counts / counts)
    return Window(first_ring, last_ring, low_counts, width * per_rad)


@cached(inline="always", **PLAIN)
def columns_of(window: Window, phase_counts: float, first_column: Ints, columns: int) -> tuple[int, int]:
    """Return the indices [first, last) of a ring's columns in a window; `last` may exceed the number of columns.

    `first_column` (counts + 1,) is as in `Rays`.
    """
    counts = len(first_column) - 1
    start = window.low_counts - phase_counts
    if start < 0.0:
        start += counts
    stop = start + window.width_counts
    first = first_column[min(int(np.ceil(start)), counts)]
    end = int(np.floor(stop)) + 1
    if end <= counts:
        return first, first_column[end]
    return first, first_column[min(end - counts, counts)] + columns


@cached(inline="always", **PLAIN)
def keep(
    nearest: NearestHits, k: int, j: int, reach: float, owner: int, incidence: float, normal: float, gloss: float
) -> None:
    """Store a hit that is nearer than the previous ones of ray (k, j).

    The surface has reflectance `normal` at normal incidence.
    """
    nearest.rho_m[k, j] = reach
    nearest.owner[k, j] = owner
    nearest.cosine[k, j] = incidence
    nearest.reflectance[k, j] = normal * incidence**gloss
