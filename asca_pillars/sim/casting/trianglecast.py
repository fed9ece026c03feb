"""Rays against triangles (compiled by numba): every ray in the window of rings and columns of each is tested."""

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
