"""Rays against ellipsoids, solid ones and clouds of leaves (compiled by numba)."""

from typing import NamedTuple

import numpy as np

from asca_pillars.base.compiling import cached
from asca_pillars.geometry.arrays import Floats, Ints
from asca_pillars.sim.casting.rays import (
    PLAIN,
    TURN,
    NearestHits,
    RayLimits,
    Rays,
    Window,
    columns_of,
    keep,
    ray_chance,
    rings_of,
    window_of,
)

TUFT_M = 0.2
LONE_LEAVES = 0.35  # fraction of the rays through a cloud with a random number of their own
_NEAR_AXIS_M = 0.3
# Salts of a ray's other random numbers: far from those of bodies.
_FACING_SALT, _TUFT_SALT = 100_000_000, 200_000_000


class Extent(NamedTuple):
    """Half extents of an ellipsoid, metres."""

    up: float
    flat: float  # along the ground, at most
    across: float  # across the line of sight


class Leaves(NamedTuple):
    """Density of a cloud, and the rings and columns of its tufts, in which rays mostly share a random number."""

    density_per_m: float  # 0: solid
    rings: int
    columns: int


@cached(**PLAIN)
def extent_of(m: Floats, ux: float, uy: float) -> Extent:
    """Return the extent of |m p| = 1 seen along (ux, uy), from the rows of the inverse of m (3,3)."""
    a0 = m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1]
    a1 = m[0, 2] * m[2, 1] - m[0, 1] * m[2, 2]
    a2 = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    b0 = m[1, 2] * m[2, 0] - m[1, 0] * m[2, 2]
    b1 = m[0, 0] * m[2, 2] - m[0, 2] * m[2, 0]
    b2 = m[0, 2] * m[1, 0] - m[0, 0] * m[1, 2]
    c0 = m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0]
    c1 = m[0, 1] * m[2, 0] - m[0, 0] * m[2, 1]
    c2 = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
    size = abs(m[0, 0] * a0 + m[0, 1] * b0 + m[0, 2] * c0)
    flat = np.sqrt(a0 * a0 + a1 * a1 + a2 * a2 + b0 * b0 + b1 * b1 + b2 * b2) / size
    across = np.sqrt((uy * a0 - ux * b0) ** 2 + (uy * a1 - ux * b1) ** 2 + (uy * a2 - ux * b2) ** 2) / size
    return Extent(np.sqrt(c0 * c0 + c1 * c1 + c2 * c2) / size, flat, across)


@cached(**PLAIN)
def ellipsoid_window(center: Floats, m: Floats, distance: float, limits: RayLimits) -> Window:
    """Return the window of an ellipsoid |m p| = 1, m (3,3), around a center (3,) at `distance` metres.

    It is empty if the ellipsoid is outside the wedge of columns that are cast.
    """
    cx, cy, cz = center[0], center[1], center[2]
    ux, uy = cx / max(distance, 1e-9), cy / max(distance, 1e-9)
    extent = extent_of(m, ux, uy)
    if limits.wedge_slope > 0.0:
        reach = extent.flat * np.sqrt(1.0 + limits.wedge_slope**2)
        if abs(cy) - limits.wedge_slope * cx > reach:
            return Window(0, 0, 0.0, 0.0)
    near, far = max(distance - extent.flat, 0.0), distance + extent.flat
    first, last = rings_of(cz - extent.up, cz + extent.up, near, far, limits)
    if first >= last:
        return Window(0, 0, 0.0, 0.0)
    if distance <= extent.flat + _NEAR_AXIS_M:
        return window_of(first, last, -np.pi, TURN, limits)
    # Half the width seen from the axis: the extent across the line of sight, nearer than the center at most by the
    # extent along it.
    half_angle = np.arctan(extent.across / (distance - extent.flat))
    return window_of(first, last, np.arctan2(cy, cx) - half_angle, 2 * half_angle, limits)


@cached(**PLAIN)
def leaves_of(density_per_m: float, distance: float, slope: Floats, columns_per_turn: int) -> Leaves:
    """Return the leaves of a cloud, which grow in tufts, so that crowns have depth and not only noise.

    The cloud is `distance` metres away; slope (K,) is as in `Rays`.
    """
    away = max(distance, 2.0)
    columns = int(TUFT_M / (away * 2.0 * np.pi / columns_per_turn))
    rings = int(TUFT_M / (away * abs(slope[0] - slope[-1]) / len(slope)))
    return Leaves(density_per_m, max(rings, 1), max(columns, 1))


@cached(inline="always", **PLAIN)
def leaf_chance(leaves: Leaves, k: int, j: int, salt: int, key: int) -> float:
    """Return the random number for the depth that a ray reaches in a cloud: its own, or that of its tuft."""
    chance = ray_chance(key, k, j, salt)
    if chance < LONE_LEAVES:
        return chance / LONE_LEAVES
    return ray_chance(key, k // leaves.rings, j // leaves.columns, salt + _TUFT_SALT)


@cached(inline="always", **PLAIN)
def solid_cosine(m: Floats, x: float, y: float, z: float, dx: float, dy: float, dz: float, stretch: float) -> float:
    """Return the cosine of incidence of a ray (dx, dy, dz) at (x, y, z) of the unit frame, of |m p| = 1, m (3,3)."""
    nx = m[0, 0] * x + m[1, 0] * y + m[2, 0] * z
    ny = m[0, 1] * x + m[1, 1] * y + m[2, 1] * z
    nz = m[0, 2] * x + m[1, 2] * y + m[2, 2] * z
    facing = abs(nx * dx + ny * dy + nz * dz)
    return min(facing / (np.sqrt(nx * nx + ny * ny + nz * nz) * stretch), 1.0)


@cached(**PLAIN)
def cast_ellipsoids(
    centers: Floats,
    unit_from_world: Floats,
    surface: Floats,
    owners: Ints,
    salts: Ints,
    rays: Rays,
    nearest: NearestHits,
    key: int,
) -> None:
    """Keep the nearest hit of E ellipsoids; count the rays that each object alone would stop.

    Centers (E,3), unit_from_world (E,3,3) and surface (E,3) are as in `Primitives`: metres, LiDAR frame.
    """
    # Unpacked from their tuples once: numba counts references at every access.
    slopes, stretch, origins, phase_counts = rays.slope, rays.stretch, rays.origin_z_m, rays.phase_counts
    cos_phase, sin_phase, cos_azimuth, sin_azimuth = rays.cos_phase, rays.sin_phase, rays.cos_azimuth, rays.sin_azimuth
    first_column, number, counted = rays.first_column, rays.number, rays.counted
    rho, stamp, alone = nearest.rho_m, nearest.stamp, nearest.alone
    columns, limits, per_turn = len(number), rays.limits, rays.columns_per_turn
    for e in range(len(centers)):
        center, m = centers[e], unit_from_world[e]
        distance = np.hypot(center[0], center[1])
        window = ellipsoid_window(center, m, distance, limits)
        if window.first_ring >= window.last_ring:
            continue
        leaves = leaves_of(surface[e, 2], distance, slopes, per_turn)
        cloud = leaves.density_per_m > 0.0
        owner, salt = owners[e], salts[e]
        for k in range(window.first_ring, window.last_ring):
            first, last = columns_of(window, phase_counts[k], first_column, columns)
            if first >= last:
                continue
            cos, sin, dz, up = cos_phase[k], sin_phase[k], slopes[k], origins[k] - center[2]
            # Origins of the rays of the ring in the unit frame of the ellipsoid.
            p0 = m[0, 2] * up - m[0, 0] * center[0] - m[0, 1] * center[1]
            p1 = m[1, 2] * up - m[1, 0] * center[0] - m[1, 1] * center[1]
            p2 = m[2, 2] * up - m[2, 0] * center[0] - m[2, 1] * center[1]
            outside = p0 * p0 + p1 * p1 + p2 * p2 - 1.0
            for column in range(first, last):
                j = column if column < columns else column - columns
                dx = cos_azimuth[j] * cos - sin_azimuth[j] * sin
                dy = sin_azimuth[j] * cos + cos_azimuth[j] * sin
                q0 = m[0, 0] * dx + m[0, 1] * dy + m[0, 2] * dz
                q1 = m[1, 0] * dx + m[1, 1] * dy + m[1, 2] * dz
                q2 = m[2, 0] * dx + m[2, 1] * dy + m[2, 2] * dz
                qq, pq = q0 * q0 + q1 * q1 + q2 * q2, p0 * q0 + p1 * q1 + p2 * q2
                root = pq * pq - qq * outside
                if root <= 0.0:
                    continue
                root = np.sqrt(root)
                leave, reach = (-pq + root) / qq, (-pq - root) / qq
                if leave <= 0.0 or (reach <= 0.0 and not cloud) or (owner < 0 and reach >= rho[k, j]):
                    continue
                if cloud:
                    depth = -np.log(leaf_chance(leaves, k, number[j], salt, key)) / (leaves.density_per_m * stretch[k])
                    reach = max(reach, 0.0) + depth
                    if reach >= leave:
                        continue
                if owner >= 0 and counted[j] and stamp[k, j] != owner:
                    stamp[k, j] = owner
                    alone[owner] += 1
                if reach >= rho[k, j]:
                    continue
                if cloud:  # leaves have any orientation
                    cosine = 0.35 + 0.65 * ray_chance(key, k, number[j], salt + _FACING_SALT)
                else:
                    x, y, z = p0 + reach * q0, p1 + reach * q1, p2 + reach * q2
                    cosine = solid_cosine(m, x, y, z, dx, dy, dz, stretch[k])
                keep(nearest, k, j, reach, owner, cosine, surface[e, 0], surface[e, 1])
