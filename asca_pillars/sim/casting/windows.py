"""Which rays can meet a body, by what chance, and keeping the nearest hit (compiled by numba).

Compiled code is cached per file, and numba does not notice a change of another file: after a change here, delete the
__pycache__ folder, or the casters of triangles and ellipsoids go on with what they were compiled with.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from asca_pillars.base.compiling import cached
from asca_pillars.sim.casting.rays import NearestHits, RayLimits

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
PLAIN = {"error_model": "numpy"}  # NumPy's division, which does not look out for zeros
TURN = 2 * np.pi - 1e-9


class Window(NamedTuple):
    """Rings [first_ring, last_ring) and azimuths [low_counts, low_counts + width_counts] that can meet a body.

    Azimuths are in counts of the encoder, low_counts within one revolution from 0.
    """

    first_ring: int
    last_ring: int
    low_counts: float
    width_counts: float


@cached(inline="always", **PLAIN)
def ray_bits(key: int, ring: int, column: int, salt: int) -> np.uint64:
    """64 random bits from a key, a ray and a salt (the finalizer of splitmix64)."""
    number = (np.uint64(salt) << np.uint64(24)) ^ np.uint64(ring * 4096 + column)
    z = np.uint64(key) + number * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@cached(inline="always", **PLAIN)
def ray_chance(key: int, ring: int, column: int, salt: int) -> float:
    """A uniform number in (0, 1) of a ray and a salt."""
    return (float(ray_bits(key, ring, column, salt) >> np.uint64(11)) + 0.5) * (1.0 / 9007199254740992.0)


@cached(**PLAIN)
def ring_below(slope: Floats, limit: float) -> int:
    """The index of the first ring whose slope is not above `limit`; slopes (K,) fall."""
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
    """The rings [first, last) that can meet what lies between two heights and two horizontal distances."""
    above = z_high - limits.lowest_origin_m
    below = z_low - limits.highest_origin_m
    near = max(near, 1e-6)
    steepest = above / near if above > 0 else above / far
    shallowest = below / far if below > 0 else below / near
    first = ring_below(limits.slope, steepest)
    return first, max(ring_below(limits.slope, np.nextafter(shallowest, -np.inf)), first)


@cached(**PLAIN)
def window_of(first_ring: int, last_ring: int, low: float, width: float, limits: RayLimits) -> Window:
    """The window of these rings and of azimuths [low, low + width]."""
    counts = limits.counts
    per_rad = counts / (2.0 * np.pi)
    low_counts = low * per_rad
    low_counts -= counts * np.floor(low_counts / counts)
    return Window(first_ring, last_ring, low_counts, width * per_rad)


@cached(inline="always", **PLAIN)
def columns_of(window: Window, phase_counts: float, first_column: Ints, columns: int) -> tuple[int, int]:
    """Indices [first, last) of a ring's columns that lie in a window; `last` may exceed the number of columns.

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
    nearest: NearestHits, k: int, j: int, reach: float, who: int, incidence: float, normal: float, gloss: float
) -> None:
    """Note a hit that is nearer than what ray (k, j) has met so far.

    The surface has reflectance `normal` at normal incidence.
    """
    nearest.rho_m[k, j] = reach
    nearest.owner[k, j] = who
    nearest.cosine[k, j] = incidence
    nearest.reflectance[k, j] = normal * incidence**gloss
