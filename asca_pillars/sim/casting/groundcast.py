"""Rays against the ground, marched down to it; its height and material (compiled by numba; see `rays`)."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.compiling import cached
from asca_pillars.geometry.boxes import Floats, Mask
from asca_pillars.sim.casting.rays import PLAIN, NearestHits, Rays, ray_chance

GROUND = -2  # owner of ground returns
BANK_RUN_M = 6.0  # a bank rises over this distance and is level beyond
DITCH_HALF_M = 1.0
TRACK_SPACING_HALF_M, GAUGE_HALF_M, RAIL_HALF_M = 1.7, 0.75, 0.06
RELIEF_STEP_M = 4.0
RELIEF_HALF_M = 96.0
NO_RAILS = -1000.0
ASPHALT, PAVEMENT, VERGE, MARKING, RAIL, BALLAST = range(6)


class Street(NamedTuple):
    """Shape of the ground of a street: metres, slopes and radians, in road coordinates (`world.ground`).

    Parts with size 0 are absent.
    """

    yaw_rad: float
    bend_per_m: float
    offset_m: float
    half_width_m: float
    cross_u_m: float
    cross_half_m: float
    cross_tilt_rad: float
    kerb_m: float
    pavement_m: float
    lane_m: float
    bank_left: float
    bank_right: float
    rails_v_m: float  # NO_RAILS without rails
    median_half_m: float
    rough_m: float
    camber: float
    tracks: float
    rail_m: float
    bed_m: float
    bed_half_m: float
    second_v_m: float
    second_half_m: float
    ditch_m: float
    along_m: float  # distance driven along x since the scene was drawn; hills and markings do not move
    # Derived values, cached because heights are computed by the million.
    cos_yaw: float
    sin_yaw: float
    cos_tilt: float
    sin_tilt: float
    rise_m: float  # largest height of all parts above the hills


@cached(**PLAIN)
def heights(points: Floats, street: Street, relief: Floats, z_m: float) -> Floats:
    """Return `ground_height` of many points (N,2)."""
    result = np.empty(len(points))
    for i in range(len(points)):
        result[i] = ground_height(points[i, 0], points[i, 1], street, relief, z_m)
    return result


# Called in many places: LLVM inlines these three in a third of the time that numba takes.
@cached(forceinline=True, **PLAIN)
def road_distances(x: float, y: float, street: Street) -> tuple[float, float, float, float, float]:
    """Return road coordinates u, v, then the distances outside the main road, the crossing road and both, metres.

    Distances are negative inside. The main road is either carriageway.
    """
    cos, sin = street.cos_yaw, street.sin_yaw
    u = x * cos + y * sin
    v = y * cos - x * sin - street.offset_m - 0.5 * street.bend_per_m * u * u
    main = abs(v) - street.half_width_m
    if street.second_half_m > 0.0:
        main = min(main, abs(v - street.second_v_m) - street.second_half_m)
    cross = 1e3
    if street.cross_half_m > 0.0:
        cross = abs((u - street.cross_u_m) * street.cos_tilt + v * street.sin_tilt) - street.cross_half_m
    return u, v, main, cross, min(main, cross)


@cached(**PLAIN)
def outside_roads(points: Floats, street: Street) -> Floats:
    """Return the distance of each of (N,2) points to the outside of all roads (negative inside), metres."""
    result = np.empty(len(points))
    for i in range(len(points)):
        _, _, _, _, result[i] = road_distances(points[i, 0], points[i, 1], street)
    return result


@cached(inline="always", **PLAIN)
def on_rail(from_middle: float, tracks: float) -> bool:
    """Return whether a position at that distance from the middle of one track or of two is on a rail."""
    if tracks > 1.0:
        from_middle = abs(from_middle - TRACK_SPACING_HALF_M)
    return abs(from_middle - GAUGE_HALF_M) < RAIL_HALF_M


@cached(forceinline=True, **PLAIN)
def ground_height(x: float, y: float, street: Street, relief: Floats, z_m: float) -> float:
    """Return the height of the ground at (x, y): hills, with kerb, camber, banks and median added.

    All in metres, LiDAR frame; relief (R, R) holds heights above z_m, as in `Ground`.
    """
    cells = relief.shape[0] - 1
    row = min(max((x + street.along_m + RELIEF_HALF_M) / RELIEF_STEP_M, 0.0), cells - 1e-6)
    col = min(max((y + RELIEF_HALF_M) / RELIEF_STEP_M, 0.0), cells - 1e-6)
    i, j = int(row), int(col)
    a, b = row - i, col - j
    height = (relief[i, j] * (1 - a) + relief[i + 1, j] * a) * (1 - b)
    height += (relief[i, j + 1] * (1 - a) + relief[i + 1, j + 1] * a) * b
    _, v, main, cross, outside = road_distances(x, y, street)
    if outside <= 0.0:
        height += street.camber * min(-main, 4.0) if main < 0 else 0.0
        if street.median_half_m > 0.0 and abs(v) < street.median_half_m and cross > 3.0:
            height += street.kerb_m
    else:
        height += street.kerb_m * min(outside / 0.05, 1.0)
        beyond = outside - street.pavement_m
        if beyond > 0.0 and cross > 2.0:
            away = min((cross - 2.0) / 6.0, 1.0)  # banks and ditches end at a crossing gradually
            if street.ditch_m > 0.0:
                height -= away * street.ditch_m * max(1.0 - abs(beyond / DITCH_HALF_M - 1.0), 0.0)
                beyond = max(beyond - 2.0 * DITCH_HALF_M, 0.0)
            height += away * (street.bank_left if v > 0 else street.bank_right) * min(beyond, BANK_RUN_M)
    if street.rails_v_m > NO_RAILS:
        from_middle = abs(v - street.rails_v_m)
        if from_middle < street.bed_half_m and cross > 1.0:
            height += street.bed_m * min((street.bed_half_m - from_middle) / 0.25, 1.0)
        if on_rail(from_middle, street.tracks):
            height += street.rail_m
    return z_m + height


@cached(inline="always", **PLAIN)
def ground_material(x: float, y: float, street: Street) -> int:
    """Return the material of the ground at (x, y)."""
    u, v, main, cross, outside = road_distances(x, y, street)
    if street.rails_v_m > NO_RAILS:
        from_middle = abs(v - street.rails_v_m)
        if on_rail(from_middle, street.tracks):
            return RAIL
        if from_middle < street.bed_half_m and cross > 1.0:
            return BALLAST
    if outside > 0.0:
        return VERGE if outside > street.pavement_m else PAVEMENT
    if street.median_half_m > 0.0 and abs(v) < street.median_half_m:
        return VERGE
    lane = street.lane_m
    if lane > 0.0 and main < 0.0 and cross > 0.0:
        to_line = abs(v / lane - np.round(v / lane)) * lane
        dashed = u + street.along_m
        if to_line < 0.07 and dashed - 9.0 * np.floor(dashed / 9.0) < 4.0:
            return MARKING
        if main > -0.32 and main < -0.18:
            return MARKING
    return ASPHALT


@cached(**PLAIN)
def highest_within(relief: Floats, along_m: float) -> Floats:
    """Return the highest (R - 1,) of relief (R, R), metres, within each multiple of RELIEF_STEP_M of the car.

    Rays may start below it.
    """
    half = relief.shape[0] // 2
    driven = along_m / RELIEF_STEP_M
    highest = np.full(2 * half, relief.min())
    for i in range(relief.shape[0]):
        for j in range(relief.shape[1]):
            # A lattice point shapes the cells around it, up to 1.5 steps nearer than itself.
            ring = min(max(int(np.hypot(i - half - driven, j - half) - 1.5), 0), 2 * half - 1)
            highest[ring] = max(highest[ring], relief[i, j])
    for ring in range(1, len(highest)):
        highest[ring] = max(highest[ring], highest[ring - 1])
    return highest


GROUP_DEG = 1.2  # less than the margin of casting beyond the image's edges
CLEAR_M = 0.5  # neighbors of a ray so high above the ground are above it, too
LOW_M = 0.45  # below this height, the ray is tested where its neighbor hit the ground
MET_M, SAME_M = 0.001, 0.0003  # a ray so near to the ground, or so little below it, hits it
START_M, REACH_M = 1.5, 85.0
GRASS_SALT = 900_000_000


class Descent(NamedTuple):
    """Ray over the ground, and its last positions on the way down.

    It was above at `near_m`, and at `reach_m` below (or beyond its limit); `clear_m` is the last position at which it,
    and all before, was CLEAR_M above the ground.
    """

    near_m: float
    above_m: float
    reach_m: float
    gap_m: float
    clear_m: float


class GroundRay(NamedTuple):
    """Ray from (0, 0, up) that falls by -slope per metre towards (dx, dy)."""

    up: float
    slope: float
    dx: float
    dy: float


@cached(forceinline=True, **PLAIN)
def gap_at(ray: GroundRay, reach: float, street: Street, relief: Floats, z_m: float) -> float:
    """Return the height in metres of a ray above the ground, relief (R, R), at a horizontal distance."""
    return ray.up + ray.slope * reach - ground_height(reach * ray.dx, reach * ray.dy, street, relief, z_m)


@cached(**PLAIN)
def first_distance(up: float, slope: float, highest: Floats, rise: float, z_m: float) -> float:
    """Return the distance in metres over which a ray of this height and slope is above everything in any direction.

    `highest` (rings,) is the highest relief in each ring of cells around the car.
    """
    start, ring = START_M, 0
    while ring + 1 < len(highest) and up + slope * start > z_m + highest[ring] + rise:
        # Up to the far edge of this ring of cells the ray is above everything.
        meet = (z_m + highest[ring] + rise - up) / slope if slope < 0.0 else 1e9
        start = max(start, min(meet, (ring + 1) * RELIEF_STEP_M))
        if meet <= (ring + 1) * RELIEF_STEP_M:
            break
        ring += 1
    return start


@cached(inline="always", **PLAIN)
def descend(
    ray: GroundRay,
    start: float,
    clear: float,
    expected: float,
    limit: float,
    street: Street,
    relief: Floats,
    z_m: float,
) -> Descent:
    """March down a ray until it is below the ground, relief (R, R), or beyond `limit`, metres.

    A neighboring ray was high above everything up to `clear`, and hit the ground at `expected` (0: nowhere): this one
    begins there, and is tested there first once it is low.
    """
    near, reach, above = clear, clear, 0.0
    gap = gap_at(ray, reach, street, relief, z_m)
    if gap < CLEAR_M and clear > start:
        near, reach = start, start
        gap = gap_at(ray, reach, street, relief, z_m)
    clear, descending = start, max(-ray.slope, 0.0)
    far_above = descending > 0.03  # flatter rays graze crests that a neighbor may just have missed
    while gap > 0.0 and reach < limit:
        near, above = reach, gap
        far_above &= gap >= CLEAR_M
        if far_above:
            clear = reach
        if gap < LOW_M and near < expected < near + 2.0 * gap / max(descending, 0.01):
            reach, expected = min(expected, limit), 0.0
        else:
            # Ground steeper than this is a kerb or a bank, which is wider than the step that passes its foot.
            # On flat ground half of the way down is quicker; kerbs are then lower than the remaining height.
            step = max(gap / (0.22 + descending), 0.04 + 0.006 * near)
            if descending > 0.0:
                step = max(step, min(0.5 * gap / descending, 3.0))
            reach = near + step
        gap = gap_at(ray, reach, street, relief, z_m)
    return Descent(near, above, reach, gap, clear)


@cached(inline="always", **PLAIN)
def meeting(ray: GroundRay, way: Descent, street: Street, relief: Floats, z_m: float) -> tuple[float, float]:
    """Return the distance, between above and below, of a ray's hit on the ground, relief (R, R), and the gap, metres.

    Regula falsi, halving the weight of an end that stays (Illinois method).
    """
    near, above, reach, gap = way.near_m, way.above_m, way.reach_m, way.gap_m
    left = gap
    for _ in range(10):
        if reach - near < 0.004 or above <= 0.0 or left > -SAME_M:
            break
        middle = near + (reach - near) * above / (above - gap)
        middle_gap = gap_at(ray, middle, street, relief, z_m)
        if abs(middle_gap) < MET_M:
            return middle, middle_gap
        if middle_gap > 0.0:
            near, above, gap = middle, middle_gap, 0.5 * gap
        else:
            reach, gap, above, left = middle, middle_gap, 0.5 * above, middle_gap
    return reach, left


@cached(inline="always", **PLAIN)
def facing_of(ray: GroundRay, reach: float, height: float, street: Street, relief: Floats, z_m: float) -> float:
    """Return the cosine of incidence of a ray on the ground, relief (R, R), of this height in metres there."""
    x, y, step = reach * ray.dx, reach * ray.dy, 0.05
    gx = (ground_height(x + step, y, street, relief, z_m) - height) / step
    gy = (ground_height(x, y + step, street, relief, z_m) - height) / step
    gx, gy = min(max(gx, -3.0), 3.0), min(max(gy, -3.0), 3.0)
    facing = abs(ray.slope - gx * ray.dx - gy * ray.dy)
    return facing / (np.sqrt(1.0 + gx * gx + gy * gy) * np.sqrt(1.0 + ray.slope**2))


@cached(**PLAIN)
def are_needed(outside: Mask, owner: NDArray[np.int32], k: int, first: int, last: int) -> bool:
    """Return whether the ground hits of columns [first, last) of ring k are needed.

    They are for an object, which the ground may occlude, and next to a requested ray, which may straddle an edge;
    outside (K, C) is a mask as in `Rays`, owner (K, C) an index as in `NearestHits`.
    """
    rings, columns = outside.shape
    for j in range(first, last):
        if owner[k, j] >= 0:
            return True
    for row in range(max(k - 1, 0), min(k + 2, rings)):
        for j in range(first - 1, last + 1):
            if not outside[row, (j + columns) % columns]:
                return True
    return False


@cached(**PLAIN)
def cast_ground(
    street: Street, relief: Floats, materials: Floats, z_m: float, rays: Rays, nearest: NearestHits, key: int
) -> None:
    """Walk every ray down to the ground and keep the hit where nothing was nearer.

    Street, relief (R, R), materials (6,), which are reflectances, and z_m in metres are as in `Ground`.
    """
    # Unpacked from their tuples once: numba counts references at every access.
    slopes, origins, cos_phase, sin_phase = rays.slope, rays.origin_z_m, rays.cos_phase, rays.sin_phase
    cos_azimuth, sin_azimuth, number = rays.cos_azimuth, rays.sin_azimuth, rays.number
    rho, cosine, reflectance, owner = nearest.rho_m, nearest.cosine, nearest.reflectance, nearest.owner
    outside, columns = rays.outside, len(number)
    highest = highest_within(relief, street.along_m)
    rough = street.rough_m
    group = max(int(GROUP_DEG / 360.0 * rays.columns_per_turn), 1)
    for k in range(len(slopes)):
        up, slope, cos, sin = origins[k], slopes[k], cos_phase[k], sin_phase[k]
        start = first_distance(up, slope, highest, street.rise_m, z_m)
        # A neighbor's hit holds for this ray, too. Neighbors are in small groups, so that a ray does not depend on
        # whether those far from it are cast.
        clear, expected = start, 0.0
        last, needed = 0, False
        for j in range(columns):
            if j == last:
                clear, expected = start, 0.0
                last += 1
                while last < columns and number[last] % group and number[last] == number[last - 1] + 1:
                    last += 1
                needed = are_needed(outside, owner, k, j, last)
            if not needed:
                continue
            x, y = cos_azimuth[j], sin_azimuth[j]
            ray = GroundRay(up, slope, x * cos - y * sin, y * cos + x * sin)
            limit = min(rho[k, j], REACH_M)
            way = descend(ray, start, clear, expected, limit, street, relief, z_m)
            clear, expected = way.clear_m, 0.0
            if way.gap_m > 0.0:
                continue
            reach, left = meeting(ray, way, street, relief, z_m)
            if reach >= limit:
                continue
            expected = reach
            facing = facing_of(ray, reach, up + slope * reach - left, street, relief, z_m)
            material = ground_material(reach * ray.dx, reach * ray.dy, street)
            if material == VERGE:
                # Grass ends the ray before the soil, and stands upright to it.
                reach -= rough * ray_chance(key, k, number[j], GRASS_SALT) ** 2 / max(0.12, abs(slope))
                facing = max(facing, 0.08)
                if reach < START_M:
                    continue
            elif material == RAIL:
                facing = max(facing, 0.3)
            rho[k, j] = reach
            owner[k, j] = GROUND
            cosine[k, j] = min(max(facing, 0.004), 1.0)
            reflectance[k, j] = materials[material]
