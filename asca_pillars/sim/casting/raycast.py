"""Casting of a whole revolution at a whole scene: a spherical z-buffer over (ring, column).

Each triangle or ellipsoid is tested against the firings of its angular window only; there is no acceleration structure,
because every scene is used once. The ground is not meshed: each ray is marched down to its analytic height.
Random numbers (glass, foliage) belong to a firing and a primitive, so that casting fewer columns never changes
the other returns.

Ellipsoids are solid, or clouds of leaves. The loops are compiled by numba.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.compiling import cached
from asca_pillars.geometry.boxes import Floats, Ints, Singles
from asca_pillars.sim.bodies.primitives import Primitives
from asca_pillars.sim.casting.groundcast import cast_ground
from asca_pillars.sim.casting.rays import (
    NOTHING,
    PLAIN,
    TURN,
    NearestHits,
    RayLimits,
    Rays,
    Window,
    columns_of,
    keep,
    no_hits,
    ray_chance,
    rays_of,
    rings_of,
    window_of,
)
from asca_pillars.sim.lidar import Firings
from asca_pillars.sim.world.ground import Ground

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


class Edge(NamedTuple):
    """Normal of the plane through an edge of a triangle and the point (0, 0, z): (x + z x_up, y + z y_up, up)."""

    x: float
    y: float
    x_up: float
    y_up: float
    up: float


class Plane(NamedTuple):
    """Plane of points p with normal (x, y, z) * p = away."""

    x: float
    y: float
    z: float
    away: float


@cached(inline="always", **PLAIN)
def edge_of(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> Edge:
    """Return the edge from a to b; exactly the negative of that from b to a, so that neighbors leave no gap."""
    return Edge(ay * bz - az * by, az * bx - ax * bz, by - ay, ax - bx, ax * by - ay * bx)


@cached(**PLAIN)
def nearest_on_edge(ax: float, ay: float, bx: float, by: float) -> float:
    """Return the square of the horizontal distance from the sensor's axis to the segment a b."""
    dx, dy = bx - ax, by - ay
    length = dx * dx + dy * dy
    share = 0.0
    if length > 1e-12:
        share = min(max(-(ax * dx + ay * dy) / length, 0.0), 1.0)
    x, y = ax + share * dx, ay + share * dy
    return x * x + y * y


@cached(inline="always", **PLAIN)
def wrap(angle: float) -> float:
    """Return the angle in [-pi, pi), radians."""
    return angle - 2 * np.pi * np.floor((angle + np.pi) / (2 * np.pi))


@cached(**PLAIN)
def triangle_window(corner: Floats, limits: RayLimits) -> Window:
    """Return the window of a triangle (3,3), metres; empty outside the wedge of columns that are cast."""
    ax, ay, bx, by, cx, cy = corner[0, 0], corner[0, 1], corner[1, 0], corner[1, 1], corner[2, 0], corner[2, 1]
    if limits.wedge_slope > 0.0:
        wedge = limits.wedge_slope
        left = ay > wedge * ax and by > wedge * bx and cy > wedge * cx
        right = ay < -wedge * ax and by < -wedge * bx and cy < -wedge * cx
        if left or right:
            return Window(0, 0, 0.0, 0.0)
    ab, bc, ca = ax * by - ay * bx, bx * cy - by * cx, cx * ay - cy * ax
    encloses_axis = (ab > 0 and bc > 0 and ca > 0) or (ab < 0 and bc < 0 and ca < 0)
    nearest = min(nearest_on_edge(ax, ay, bx, by), nearest_on_edge(bx, by, cx, cy), nearest_on_edge(cx, cy, ax, ay))
    near = 0.0 if encloses_axis else np.sqrt(nearest)
    far = np.sqrt(max(ax * ax + ay * ay, bx * bx + by * by, cx * cx + cy * cy))
    z_low, z_high = min(corner[0, 2], corner[1, 2], corner[2, 2]), max(corner[0, 2], corner[1, 2], corner[2, 2])
    first, last = rings_of(z_low, z_high, near, far, limits)
    if first >= last:  # for most of them: azimuths are not needed
        return Window(0, 0, 0.0, 0.0)
    if encloses_axis:
        return window_of(first, last, -np.pi, TURN, limits)
    azimuth = np.arctan2(ay, ax)
    to_b = wrap(np.arctan2(by, bx) - azimuth)
    to_c = wrap(np.arctan2(cy, cx) - azimuth)
    to_first, to_last = min(0.0, to_b, to_c), max(0.0, to_b, to_c)
    return window_of(first, last, azimuth + to_first, to_last - to_first, limits)


@cached(**PLAIN)
def plane_of(corner: Floats) -> Plane:
    """Return the plane of a triangle (3,3), metres, with unit normal; all 0 for a triangle without an area."""
    ux, uy, uz = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    vx, vy, vz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    size = np.sqrt(x * x + y * y + z * z)
    if size < 1e-12:
        return Plane(0.0, 0.0, 0.0, 0.0)
    x, y, z = x / size, y / size, z / size
    return Plane(x, y, z, x * corner[0, 0] + y * corner[0, 1] + z * corner[0, 2])


@cached(inline="always", **PLAIN)
def turned(edge: Edge, up: float, cos: float, sin: float, slope: float) -> tuple[float, float, float]:
    """Return an edge's normal for a ring: of x and y of its columns, without the phase, and of 1."""
    x, y = edge.x + up * edge.x_up, edge.y + up * edge.y_up
    return x * cos + y * sin, y * cos - x * sin, edge.up * slope


@cached(inline="always", **PLAIN)
def passes(f: float, g: float, h: float) -> bool:
    """Return whether a ray is on one side of the three planes through the edges, in either orientation."""
    return (f >= 0 and g >= 0 and h >= 0) or (f <= 0 and g <= 0 and h <= 0)


@cached(**PLAIN)
def cast_triangles(
    triangles: Floats, surface: Floats, owners: Ints, salts: Ints, rays: Rays, nearest: NearestHits, key: int
) -> None:
    """Keep the nearest hit of triangles (T,3,3); count the rays that each object alone would stop."""
    # Unpacked from their tuples once: numba counts references at every access.
    slopes, stretch, origins, phase_counts = rays.slope, rays.stretch, rays.origin_z_m, rays.phase_counts
    cos_phase, sin_phase, cos_azimuth, sin_azimuth = rays.cos_phase, rays.sin_phase, rays.cos_azimuth, rays.sin_azimuth
    first_column, number, counted = rays.first_column, rays.number, rays.counted
    rho, stamp, alone = nearest.rho_m, nearest.stamp, nearest.alone
    columns, limits = len(number), rays.limits
    for t in range(len(triangles)):
        corner = triangles[t]
        window = triangle_window(corner, limits)
        if window.first_ring >= window.last_ring:
            continue
        plane = plane_of(corner)
        if plane.x == 0.0 and plane.y == 0.0 and plane.z == 0.0:
            continue
        ax, ay, az = corner[0, 0], corner[0, 1], corner[0, 2]
        bx, by, bz = corner[1, 0], corner[1, 1], corner[1, 2]
        cx, cy, cz = corner[2, 0], corner[2, 1], corner[2, 2]
        ab, bc, ca = edge_of(ax, ay, az, bx, by, bz), edge_of(bx, by, bz, cx, cy, cz), edge_of(cx, cy, cz, ax, ay, az)
        owner, salt, transparency = owners[t], salts[t], surface[t, 2]
        for k in range(window.first_ring, window.last_ring):
            first, last = columns_of(window, phase_counts[k], first_column, columns)
            if first >= last:
                continue
            up, slope, cos, sin = origins[k], slopes[k], cos_phase[k], sin_phase[k]
            fx, fy, f1 = turned(ab, up, cos, sin, slope)
            gx, gy, g1 = turned(bc, up, cos, sin, slope)
            hx, hy, h1 = turned(ca, up, cos, sin, slope)
            away = plane.away - plane.z * up
            mx, my, m1 = plane.x * cos + plane.y * sin, plane.y * cos - plane.x * sin, plane.z * slope
            for column in range(first, last):
                j = column if column < columns else column - columns
                x, y = cos_azimuth[j], sin_azimuth[j]
                facing = mx * x + my * y + m1
                if facing == 0.0:
                    continue
                if not passes(fx * x + fy * y + f1, gx * x + gy * y + g1, hx * x + hy * y + h1):
                    continue
                reach = away / facing
                hidden = reach >= rho[k, j]
                counts = owner >= 0 and counted[j] and stamp[k, j] != owner
                if reach <= 0.0 or (hidden and not counts):
                    continue
                if transparency > 0.0 and ray_chance(key, k, number[j], salt) < transparency:
                    continue
                if counts:
                    stamp[k, j] = owner
                    alone[owner] += 1
                if not hidden:
                    keep(nearest, k, j, reach, owner, abs(facing) / stretch[k], surface[t, 0], surface[t, 1])


__all__ = ["NOTHING", "Bodies", "Hits", "cast"]


class Hits(NamedTuple):
    """First hit of each firing (K rings, C columns)."""

    rho_m: Floats  # (K,C) horizontal distance from the sensor's axis; inf without a hit
    cosine: Singles  # (K,C) of the angle of incidence
    reflectance: Singles  # (K,C) of the material at this incidence
    owner: NDArray[np.int32]  # (K,C) object index, BACKGROUND, GROUND or NOTHING
    alone: Ints  # (objects,) counted firings that would hit the object if it stood alone
    visible: Ints  # (objects,) those that do hit it


class Bodies(NamedTuple):
    """Geometry of a scene: primitives, each with its owner and a salt.

    The owner is an object's index or BACKGROUND; each object's primitives are consecutive. The salt makes a
    primitive's random numbers (glass, foliage) differ from those of the others.
    """

    primitives: Primitives
    tri_owner: Ints  # (T,)
    tri_salt: Ints  # (T,)
    ell_owner: Ints  # (E,)
    ell_salt: Ints  # (E,)


def cast(bodies: Bodies, objects: int, ground: Ground | None, firings: Firings, seed: int) -> Hits:
    """Cast every firing at bodies and ground; `objects` is the number of labelled objects."""
    primitives = bodies.primitives
    rays, nearest = rays_of(firings), no_hits(firings, objects)
    key = np.uint64(seed & 0xFFFFFFFFFFFFFFFF)
    cast_triangles(
        primitives.triangles,
        primitives.triangle_surface,
        bodies.tri_owner,
        bodies.tri_salt,
        rays,
        nearest,
        key,
    )
    cast_ellipsoids(
        primitives.centers,
        primitives.unit_from_world,
        primitives.ellipsoid_surface,
        bodies.ell_owner,
        bodies.ell_salt,
        rays,
        nearest,
        key,
    )
    if ground is not None:
        cast_ground(ground.street, ground.relief, ground.reflectance, ground.z_m, rays, nearest, key)
    seen = nearest.owner[:, firings.counted]
    visible = np.bincount(seen[seen >= 0], minlength=objects).astype(np.int64)
    return Hits(nearest.rho_m, nearest.cosine, nearest.reflectance, nearest.owner, nearest.alone, visible)
