"""The height and the material of the ground (compiled by numba)."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from asca_pillars.base.compiling import cached
from asca_pillars.sim.casting.windows import PLAIN

Floats = npt.NDArray[np.float64]

GROUND = -2  # owner of what the ground returns
BANK_RUN_M = 6.0  # a bank rises over this way and is level beyond
DITCH_HALF_M = 1.0
TRACK_SPACING_HALF_M, GAUGE_HALF_M, RAIL_HALF_M = 1.7, 0.75, 0.06
RELIEF_STEP_M = 4.0
RELIEF_HALF_M = 96.0
NO_RAILS = -1000.0
ASPHALT, PAVEMENT, VERGE, MARKING, RAIL, BALLAST = range(6)


class Street(NamedTuple):
    """What the ground of a street looks like: metres, slopes and radians, in road coordinates (`world.ground`).

    What is 0 is absent.
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
    rails_v_m: float  # NO_RAILS where there are none
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
    along_m: float  # how far along x the car has driven since the scene was drawn; hills and markings stay behind
    # Derived, because heights are asked for by the million.
    cos_yaw: float
    sin_yaw: float
    cos_tilt: float
    sin_tilt: float
    rise_m: float  # how far all that may stand above the hills


@cached(**PLAIN)
def heights(points: Floats, street: Street, relief: Floats, z_m: float) -> Floats:
    """`ground_height` of many points (N,2)."""
    result = np.empty(len(points))
    for i in range(len(points)):
        result[i] = ground_height(points[i, 0], points[i, 1], street, relief, z_m)
    return result


@cached(inline="always", **PLAIN)
def road_distances(x: float, y: float, street: Street) -> tuple[float, float, float, float, float]:
    """Road coordinates u, v, then how far outside the main road, the crossing road and both (negative inside), metres.

    The main road is either carriageway.
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
    """How far each of (N,2) points lies outside all roads (negative inside), metres."""
    result = np.empty(len(points))
    for i in range(len(points)):
        _, _, _, _, result[i] = road_distances(points[i, 0], points[i, 1], street)
    return result


@cached(inline="always", **PLAIN)
def on_rail(from_middle: float, tracks: float) -> bool:
    """Whether a place that far from the middle of one track or of two lies on a rail."""
    if tracks > 1.0:
        from_middle = abs(from_middle - TRACK_SPACING_HALF_M)
    return abs(from_middle - GAUGE_HALF_M) < RAIL_HALF_M


@cached(inline="always", **PLAIN)
def ground_height(x: float, y: float, street: Street, relief: Floats, z_m: float) -> float:
    """Height of the ground at (x, y): hills, then kerb, camber, banks and median on top of them.

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
            away = min((cross - 2.0) / 6.0, 1.0)  # banks and ditches end at a crossing, not as a cliff
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
    """Material of the ground at (x, y)."""
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
    """Highest (R - 1,) of relief (R, R), metres, within each multiple of RELIEF_STEP_M of the car.

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
