"""Rays against triangles and ellipsoids (compiled by numba).

`sensor` and `buffers` are the tuples that `raycast.cast` makes; numba wants them plain. Compiled code is cached per
file, and numba does not notice a change of another file: nothing here calls compiled code of another module.
"""

import numba
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
TUFT_M = 0.2
LONE_LEAVES = 0.35  # share of the rays through a cloud that meet it by a chance of their own


@numba.njit(cache=True, inline="always")
def hash(key: int, number: int) -> float:
    """A uniform number in (0, 1) from a key and a counter (the finaliser of splitmix64)."""
    z = np.uint64(key) + np.uint64(number) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return (float(z >> np.uint64(11)) + 0.5) * (1.0 / 9007199254740992.0)


@numba.njit(cache=True, inline="always")
def ray_hash(key: int, ring: int, column: int, salt: int) -> float:
    return hash(key, (np.uint64(salt) << np.uint64(24)) ^ np.uint64(ring * 4096 + column))


@numba.njit(cache=True)
def ring_window(
    z_low: float, z_high: float, near: float, far: float, slope: Floats, origin_z: Floats
) -> tuple[int, int]:
    """First and last-plus-one ring that can meet something between two heights and two horizontal distances."""
    above = z_high - origin_z[-1]
    below = z_low - origin_z[0]
    near = max(near, 1e-6)
    steepest = above / near if above > 0 else above / far
    shallowest = below / far if below > 0 else below / near
    rings = len(slope)
    first = 0
    while first < rings and slope[first] > steepest:
        first += 1
    last = rings
    while last > first and slope[last - 1] < shallowest:
        last -= 1
    return first, last


@numba.njit(cache=True, inline="always")
def column_window(low: float, width: float, phase: float, first_column: Ints, columns: int) -> tuple[int, int]:
    """Columns [first, last) whose azimuth lies in [low, low + width]; `last` may exceed the number of columns."""
    counts = len(first_column) - 1
    unit = 2.0 * np.pi / counts
    start = (low - phase) / unit
    start -= counts * np.floor(start / counts)
    stop = start + width / unit
    first = first_column[min(int(np.ceil(start)), counts)]
    end = int(np.floor(stop)) + 1
    if end <= counts:
        return first, first_column[end]
    return first, first_column[min(end - counts, counts)] + columns


@numba.njit(cache=True)
def any_cast(low: float, width: float, first_column: Ints, cast_columns: npt.NDArray[np.bool_]) -> bool:
    """Whether a window, widened by one firing, holds a column that is cast."""
    columns = len(cast_columns)
    margin = 0.008
    first, last = column_window(low - margin, min(width + 2 * margin, 6.28), 0.0, first_column, columns)
    if last - first > columns // 2:
        return True
    probe = first
    while probe < last:  # cast columns come in two long runs: probing every few degrees cannot miss them
        if cast_columns[probe % columns]:
            return True
        probe += 24
    return last > first and bool(cast_columns[(last - 1) % columns])


@numba.njit(cache=True)
def nearest_edge(a: Floats, b: Floats) -> float:
    """Horizontal distance from the sensor's axis to the segment a b."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    length = dx * dx + dy * dy
    share = 0.0
    if length > 1e-12:
        share = min(max(-(a[0] * dx + a[1] * dy) / length, 0.0), 1.0)
    return np.hypot(a[0] + share * dx, a[1] + share * dy)


@numba.njit(cache=True)
def wrap(angle: float) -> float:
    return angle - 2 * np.pi * np.floor((angle + np.pi) / (2 * np.pi))


@numba.njit(cache=True)
def cast_triangles(triangles, surface, owners, salts, sensor, buffers, key):  # type: ignore[no-untyped-def]
    """Keep the nearest hit of triangles (T,3,3) in the buffers; count what each object alone would stop."""
    slope, origin_z, phase, cos_az, sin_az, first_column, cast_columns, counted = sensor
    rho, cosine, reflectance, owner, stamp, alone = buffers
    columns = len(cos_az)
    edges = np.empty((3, 3))
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        azimuth = np.arctan2(a[1], a[0])
        to_b = wrap(np.arctan2(b[1], b[0]) - azimuth)
        to_c = wrap(np.arctan2(c[1], c[0]) - azimuth)
        if abs(to_b - to_c) > np.pi:  # the triangle encloses the sensor's axis
            low, width, near = -np.pi, 2 * np.pi - 1e-9, 0.0
        else:
            low = azimuth + min(0.0, to_b, to_c)
            width = max(0.0, to_b, to_c) - min(0.0, to_b, to_c)
            near = min(nearest_edge(a, b), nearest_edge(b, c), nearest_edge(c, a))
        if not any_cast(low, width, first_column, cast_columns):
            continue
        far = max(np.hypot(a[0], a[1]), np.hypot(b[0], b[1]), np.hypot(c[0], c[1]))
        first_ring, last_ring = ring_window(min(a[2], b[2], c[2]), max(a[2], b[2], c[2]), near, far, slope, origin_z)
        if first_ring >= last_ring:
            continue
        normal = np.cross(b - a, c - a)
        size = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        if size < 1e-12:
            continue
        normal /= size
        who = owners[t]
        for k in range(first_ring, last_ring):
            first, last = column_window(low, width, phase[k], first_column, columns)
            if first >= last:
                continue
            up = origin_z[k]
            cos_p, sin_p = np.cos(phase[k]), np.sin(phase[k])
            for e in range(3):
                p, q = triangles[t, e], triangles[t, (e + 1) % 3]
                pz, qz = p[2] - up, q[2] - up
                nx, ny = p[1] * qz - pz * q[1], pz * q[0] - p[0] * qz
                edges[e, 0] = nx * cos_p + ny * sin_p
                edges[e, 1] = ny * cos_p - nx * sin_p
                edges[e, 2] = (p[0] * q[1] - p[1] * q[0]) * slope[k]
            away = normal[0] * a[0] + normal[1] * a[1] + normal[2] * (a[2] - up)
            mx = normal[0] * cos_p + normal[1] * sin_p
            my = normal[1] * cos_p - normal[0] * sin_p
            mz = normal[2] * slope[k]
            stretch = np.sqrt(1.0 + slope[k] ** 2)
            for column in range(first, last):
                j = column if column < columns else column - columns
                if not cast_columns[j]:
                    continue
                x, y = cos_az[j], sin_az[j]
                f = edges[0, 0] * x + edges[0, 1] * y + edges[0, 2]
                g = edges[1, 0] * x + edges[1, 1] * y + edges[1, 2]
                h = edges[2, 0] * x + edges[2, 1] * y + edges[2, 2]
                if not ((f >= 0 and g >= 0 and h >= 0) or (f <= 0 and g <= 0 and h <= 0)):
                    continue
                facing = mx * x + my * y + mz
                if facing == 0.0:
                    continue
                reach = away / facing
                if reach <= 0.0:
                    continue
                hidden = reach >= rho[k, j]
                counts = who >= 0 and counted[j] and stamp[k, j] != who
                if hidden and not counts:
                    continue
                if surface[t, 2] > 0.0 and ray_hash(key, k, j, salts[t]) < surface[t, 2]:
                    continue
                if counts:
                    stamp[k, j] = who
                    alone[who] += 1
                if not hidden:
                    incidence = abs(facing) / stretch
                    rho[k, j] = reach
                    owner[k, j] = who
                    cosine[k, j] = incidence
                    reflectance[k, j] = surface[t, 0] * incidence ** surface[t, 1]


@numba.njit(cache=True)
def cast_ellipsoids(centers, matrices, inverses, surface, owners, salts, sensor, buffers, key):  # type: ignore[no-untyped-def]
    """The same for ellipsoids, solid ones and clouds; `inverses` of `matrices`, for which numba would want SciPy."""
    slope, origin_z, phase, cos_az, sin_az, first_column, cast_columns, counted = sensor
    rho, cosine, reflectance, owner, stamp, alone = buffers
    columns = len(cos_az)
    for e in range(len(centers)):
        cx, cy, cz = centers[e]
        m = matrices[e]
        inverse = inverses[e]
        half_x = np.sqrt(inverse[0, 0] ** 2 + inverse[0, 1] ** 2 + inverse[0, 2] ** 2)
        half_y = np.sqrt(inverse[1, 0] ** 2 + inverse[1, 1] ** 2 + inverse[1, 2] ** 2)
        half_z = np.sqrt(inverse[2, 0] ** 2 + inverse[2, 1] ** 2 + inverse[2, 2] ** 2)
        distance = np.hypot(cx, cy)
        radius = np.hypot(half_x, half_y)
        if distance <= radius + 0.3:
            low, width = -np.pi, 2 * np.pi - 1e-9
        else:
            # Half the width seen from the axis: the extent across the line of sight, nearer than the centre at most
            # by the extent along it.
            ux, uy = cx / distance, cy / distance
            across = np.sqrt(
                (uy * inverse[0, 0] - ux * inverse[1, 0]) ** 2
                + (uy * inverse[0, 1] - ux * inverse[1, 1]) ** 2
                + (uy * inverse[0, 2] - ux * inverse[1, 2]) ** 2
            )
            half_angle = np.arctan(across / (distance - radius))
            low, width = np.arctan2(cy, cx) - half_angle, 2 * half_angle
        if not any_cast(low, width, first_column, cast_columns):
            continue
        first_ring, last_ring = ring_window(
            cz - half_z, cz + half_z, max(distance - radius, 0.0), distance + radius, slope, origin_z
        )
        density = surface[e, 2]
        # Leaves grow in tufts: most rays through one share their chance, so that crowns have depth and not only noise.
        tuft_columns = max(int(TUFT_M / (max(distance, 2.0) * 2.0 * np.pi / columns)), 1)
        tuft_rings = max(int(TUFT_M / (max(distance, 2.0) * abs(slope[0] - slope[-1]) / len(slope))), 1)
        who = owners[e]
        for k in range(first_ring, last_ring):
            first, last = column_window(low, width, phase[k], first_column, columns)
            if first >= last:
                continue
            cos_p, sin_p = np.cos(phase[k]), np.sin(phase[k])
            oz = origin_z[k] - cz
            p0 = -m[0, 0] * cx - m[0, 1] * cy + m[0, 2] * oz
            p1 = -m[1, 0] * cx - m[1, 1] * cy + m[1, 2] * oz
            p2 = -m[2, 0] * cx - m[2, 1] * cy + m[2, 2] * oz
            inside = p0 * p0 + p1 * p1 + p2 * p2 - 1.0
            stretch = np.sqrt(1.0 + slope[k] ** 2)
            for column in range(first, last):
                j = column if column < columns else column - columns
                if not cast_columns[j]:
                    continue
                dx = cos_az[j] * cos_p - sin_az[j] * sin_p
                dy = sin_az[j] * cos_p + cos_az[j] * sin_p
                dz = slope[k]
                q0 = m[0, 0] * dx + m[0, 1] * dy + m[0, 2] * dz
                q1 = m[1, 0] * dx + m[1, 1] * dy + m[1, 2] * dz
                q2 = m[2, 0] * dx + m[2, 1] * dy + m[2, 2] * dz
                qq = q0 * q0 + q1 * q1 + q2 * q2
                pq = p0 * q0 + p1 * q1 + p2 * q2
                root = pq * pq - qq * inside
                if root <= 0.0:
                    continue
                root = np.sqrt(root)
                leave = (-pq + root) / qq
                if leave <= 0.0:
                    continue
                reach = max((-pq - root) / qq, 0.0)
                if density > 0.0:
                    chance = ray_hash(key, k, j, salts[e])
                    if chance < LONE_LEAVES:
                        chance /= LONE_LEAVES
                    else:
                        chance = ray_hash(key, k // tuft_rings, j // tuft_columns, salts[e] + 200_000_000)
                    reach -= np.log(chance) / (density * stretch)
                    if reach >= leave:
                        continue
                elif reach <= 0.0:
                    continue
                hidden = reach >= rho[k, j]
                counts = who >= 0 and counted[j] and stamp[k, j] != who
                if counts:
                    stamp[k, j] = who
                    alone[who] += 1
                if hidden:
                    continue
                if density > 0.0:  # leaves face anywhere
                    incidence = 0.35 + 0.65 * ray_hash(key, k, j, salts[e] + 100_000_000)
                else:
                    w0, w1, w2 = p0 + reach * q0, p1 + reach * q1, p2 + reach * q2
                    nx = m[0, 0] * w0 + m[1, 0] * w1 + m[2, 0] * w2
                    ny = m[0, 1] * w0 + m[1, 1] * w1 + m[2, 1] * w2
                    nz = m[0, 2] * w0 + m[1, 2] * w1 + m[2, 2] * w2
                    facing = abs(nx * dx + ny * dy + nz * dz)
                    incidence = min(facing / (np.sqrt(nx * nx + ny * ny + nz * nz) * stretch), 1.0)
                rho[k, j] = reach
                owner[k, j] = who
                cosine[k, j] = incidence
                reflectance[k, j] = surface[e, 0] * incidence ** surface[e, 1]
