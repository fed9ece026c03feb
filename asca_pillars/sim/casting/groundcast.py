"""The height and the material of the ground (compiled by numba)."""

import numba
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

GROUND = -2  # owner of what the ground returns
BANK_RUN_M = 6.0  # a bank rises over this way and is level beyond
DITCH_HALF_M = 1.0
TRACK_SPACING_HALF_M, GAUGE_HALF_M, RAIL_HALF_M = 1.7, 0.75, 0.06
RELIEF_STEP_M = 4.0
RELIEF_HALF_M = 96.0
NO_RAILS = -1000.0
ASPHALT, PAVEMENT, VERGE, MARKING, RAIL, BALLAST = range(6)

# Positions of the fields of Ground.shape: what numba reads has no names.
YAW, BEND, OFFSET, HALF_WIDTH, CROSS_U, CROSS_HALF, CROSS_TILT, KERB, WALK, LANE = range(10)
BANK_LEFT, BANK_RIGHT, RAILS_V, MEDIAN_HALF, ROUGH, CAMBER = range(10, 16)
TRACKS, RAIL_RISE, BED, BED_HALF, SECOND_V, SECOND_HALF, DITCH = range(16, 23)
# Derived, because heights are asked for by the million; RISE is how far all that may stand above the hills.
COS_YAW, SIN_YAW, COS_TILT, SIN_TILT, RISE = range(23, 28)


@numba.njit(cache=True)
def heights(points: Floats, shape: Floats, relief: Floats, z_m: float) -> Floats:
    """`ground_height` of many points (N,2)."""
    result = np.empty(len(points))
    for i in range(len(points)):
        result[i] = ground_height(points[i, 0], points[i, 1], shape, relief, z_m)
    return result


@numba.njit(cache=True, inline="always")
def road_distances(x: float, y: float, shape: Floats) -> tuple[float, float, float, float, float]:
    """Road coordinates u, v, then how far outside the main road (either carriageway), the crossing road and both
    (negative inside)."""
    cos, sin = shape[COS_YAW], shape[SIN_YAW]
    u = x * cos + y * sin
    v = y * cos - x * sin - shape[OFFSET] - 0.5 * shape[BEND] * u * u
    main = abs(v) - shape[HALF_WIDTH]
    if shape[SECOND_HALF] > 0.0:
        main = min(main, abs(v - shape[SECOND_V]) - shape[SECOND_HALF])
    cross = 1e3
    if shape[CROSS_HALF] > 0.0:
        cross = abs((u - shape[CROSS_U]) * shape[COS_TILT] + v * shape[SIN_TILT]) - shape[CROSS_HALF]
    return u, v, main, cross, min(main, cross)


@numba.njit(cache=True)
def outside_roads(points: Floats, shape: Floats) -> Floats:
    """How far each of (N,2) points lies outside all roads (negative inside), metres."""
    result = np.empty(len(points))
    for i in range(len(points)):
        _, _, _, _, result[i] = road_distances(points[i, 0], points[i, 1], shape)
    return result


@numba.njit(cache=True, inline="always")
def on_rail(from_middle: float, tracks: float) -> bool:
    """Whether a place that far from the middle of one track or of two lies on a rail."""
    if tracks > 1.0:
        from_middle = abs(from_middle - TRACK_SPACING_HALF_M)
    return abs(from_middle - GAUGE_HALF_M) < RAIL_HALF_M


@numba.njit(cache=True, inline="always")
def ground_height(x: float, y: float, shape: Floats, relief: Floats, z_m: float) -> float:
    """Height of the ground at (x, y): hills, then kerb, camber, banks and median on top of them."""
    cells = relief.shape[0] - 1
    row = min(max((x + RELIEF_HALF_M) / RELIEF_STEP_M, 0.0), cells - 1e-6)
    col = min(max((y + RELIEF_HALF_M) / RELIEF_STEP_M, 0.0), cells - 1e-6)
    i, j = int(row), int(col)
    a, b = row - i, col - j
    height = (relief[i, j] * (1 - a) + relief[i + 1, j] * a) * (1 - b)
    height += (relief[i, j + 1] * (1 - a) + relief[i + 1, j + 1] * a) * b
    _, v, main, cross, outside = road_distances(x, y, shape)
    if outside <= 0.0:
        height += shape[CAMBER] * min(-main, 4.0) if main < 0 else 0.0
        if shape[MEDIAN_HALF] > 0.0 and abs(v) < shape[MEDIAN_HALF] and cross > 3.0:
            height += shape[KERB]
    else:
        height += shape[KERB] * min(outside / 0.05, 1.0)
        beyond = outside - shape[WALK]
        if beyond > 0.0 and cross > 2.0:
            away = min((cross - 2.0) / 6.0, 1.0)  # banks and ditches end at a crossing, not as a cliff
            if shape[DITCH] > 0.0:
                height -= away * shape[DITCH] * max(1.0 - abs(beyond / DITCH_HALF_M - 1.0), 0.0)
                beyond = max(beyond - 2.0 * DITCH_HALF_M, 0.0)
            height += away * (shape[BANK_LEFT] if v > 0 else shape[BANK_RIGHT]) * min(beyond, BANK_RUN_M)
    if shape[RAILS_V] > NO_RAILS:
        from_middle = abs(v - shape[RAILS_V])
        if from_middle < shape[BED_HALF] and cross > 1.0:
            height += shape[BED] * min((shape[BED_HALF] - from_middle) / 0.25, 1.0)
        if on_rail(from_middle, shape[TRACKS]):
            height += shape[RAIL_RISE]
    return z_m + height


@numba.njit(cache=True)
def ground_material(x: float, y: float, shape: Floats) -> int:
    """Material of the ground at (x, y)."""
    u, v, main, cross, outside = road_distances(x, y, shape)
    if shape[RAILS_V] > NO_RAILS:
        from_middle = abs(v - shape[RAILS_V])
        if on_rail(from_middle, shape[TRACKS]):
            return RAIL
        if from_middle < shape[BED_HALF] and cross > 1.0:
            return BALLAST
    if outside > 0.0:
        return VERGE if outside > shape[WALK] else PAVEMENT
    if shape[MEDIAN_HALF] > 0.0 and abs(v) < shape[MEDIAN_HALF]:
        return VERGE
    lane = shape[LANE]
    if lane > 0.0 and main < 0.0 and cross > 0.0:
        to_line = abs(v / lane - np.round(v / lane)) * lane
        if to_line < 0.07 and u - 9.0 * np.floor(u / 9.0) < 4.0:
            return MARKING
        if main > -0.32 and main < -0.18:
            return MARKING
    return ASPHALT


@numba.njit(cache=True)
def highest_within(relief: Floats) -> Floats:
    """Highest relief (metres) within each multiple of RELIEF_STEP_M of the car; rays may start below it."""
    half = relief.shape[0] // 2
    highest = np.full(2 * half, relief[half, half])
    for i in range(relief.shape[0]):
        for j in range(relief.shape[1]):
            # A lattice point shapes the cells around it, up to 1.5 steps nearer than itself.
            ring = max(int(np.hypot(i - half, j - half) - 1.5), 0)
            highest[ring] = max(highest[ring], relief[i, j])
    for ring in range(1, len(highest)):
        highest[ring] = max(highest[ring], highest[ring - 1])
    return highest
