"""Where a scan's ground lies, and whether its axes lie as the model wants them: signs of z down, turned axes, a tilt.

What cannot be seen: a scan that is turned by half, a mirror image, and a quarter turn on a square or a crossing.
"""

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

_Floats: TypeAlias = NDArray[np.floating[Any]]

_AXES = ("x,y,z", "y,-x,z", "-x,-y,z", "-y,x,z")
"""Where forward and left are found in a scan whose own forward direction is that of the quadrant."""

_EDGE_PERCENTILES = (5, 20, 80, 95)
_SHARP_M = 0.5
"""Between the outer two percentiles where the ground is: nothing lies beyond it. Walls and trees end gradually."""
_GROUND_ABOVE_M = 1.0

_SECTOR_LENGTH = 0.6
"""Mean of the unit vectors towards the points: 0 for a whole revolution, 0.92 for a camera's view."""
_MAX_OFF_AHEAD_DEG = 45.0

_REACH_M = (3.0, 60.0)
_GROUND_BAND_M = 0.75
_HALF_WIDTH_DEG = 25.0
_MIN_POINTS = 20
_MIN_ALONG = 0.85
"""Median range of the ground ahead and behind over that to the sides: one sees further along a street than across.
None of 200 simulated whole revolutions falls below; turned by a quarter, 90 % of them do."""

_MAX_TILT_DEG = 6.0
_RING_M = (4.0, 20.0)
"""Beyond the vehicle's own roof, before the beams become sparse."""
_LOW_PERCENTILE = 10.0
"""Below it lie ditches and reflections."""
_MIN_GROUND_POINTS = 50


class FrameDoubt(NamedTuple):
    """What is odd about the axes: `about` names the kind, `axes` those that would mend it, if any would."""

    about: str
    text: str
    axes: str | None


def ground_z_m(points: NDArray[np.float32]) -> float | None:
    """Height of the ground around the sensor, metres: a low percentile of z in a near ring of the points.

    Takes finite points (N, >=3) in the LiDAR frame; None if the ring holds too few of them to tell.
    """
    x, y = points[:, 0], points[:, 1]
    with np.errstate(over="ignore"):  # infinitely far is not near
        squared_range = x * x + y * y
    ring = np.flatnonzero((squared_range > _RING_M[0] ** 2) & (squared_range < _RING_M[1] ** 2))
    near_z = points[:, 2].take(ring)
    return float(np.percentile(near_z, _LOW_PERCENTILE)) if len(near_z) >= _MIN_GROUND_POINTS else None


def doubt_frame(points: NDArray[np.float32], ground_z_m: float | None) -> FrameDoubt | None:
    """The first thing that is odd about the axes of a scan; None if nothing is.

    Args:
        points: (N, >=3) finite x, y, z in metres, in what should be the LiDAR frame; some thousands are enough.
        ground_z_m: height of the ground near the sensor, if it is seen.
    """
    x, y, z = points[:, :3].T
    with np.errstate(over="ignore"):  # infinitely far is not near
        radius = np.hypot(x, y)
    near = (radius > _RING_M[0]) & (radius < _RING_M[1])
    if doubt := _upside_down(z[near]):
        return doubt
    if doubt := _sector(x, y, radius):
        return doubt
    if ground_z_m is None:
        return None
    ground = (z < ground_z_m + _GROUND_BAND_M) & (radius > _REACH_M[0]) & (radius < _REACH_M[1])
    if doubt := _across(radius[ground], _quadrants(x[ground], y[ground], _HALF_WIDTH_DEG)):
        return doubt
    return _tilted(z[near], radius[near], _quadrants(x[near], y[near], 45.0))


def _upside_down(z: _Floats) -> FrameDoubt | None:
    """The points end sharply above the sensor, as they do at the ground, and gradually below it."""
    if len(z) < _MIN_POINTS:
        return None
    lowest, low, high, highest = np.percentile(z, _EDGE_PERCENTILES)
    if highest < _GROUND_ABOVE_M or highest - high > min(_SHARP_M, low - lowest):
        return None
    text = f"the points near the sensor end at z = {highest:.1f} m as at the ground: z may point down"
    return FrameDoubt("upside down", text, "x,-y,-z")


def _sector(x: _Floats, y: _Floats, radius: _Floats) -> FrameDoubt | None:
    """The points fill a sector that is not ahead."""
    away = radius > 0
    if not away.any():
        return None
    mean_x, mean_y = float((x[away] / radius[away]).mean()), float((y[away] / radius[away]).mean())
    middle_deg = float(np.degrees(np.arctan2(mean_y, mean_x)))
    if np.hypot(mean_x, mean_y) < _SECTOR_LENGTH or abs(middle_deg) < _MAX_OFF_AHEAD_DEG:
        return None
    quadrant = round(middle_deg / 90) % 4
    text = f"the points fill a sector about {middle_deg:+.0f} degrees, and ahead is 0: x may not be forward"
    return FrameDoubt("axes", text, _AXES[quadrant])


def _across(radius: _Floats, quadrants: list[NDArray[np.bool_]]) -> FrameDoubt | None:
    """The ground is seen further to the sides than ahead and behind."""
    reach = []
    for quadrant in quadrants:
        if np.count_nonzero(quadrant) < _MIN_POINTS:
            return None
        reach.append(float(np.median(radius[quadrant])))
    along, across = reach[0] + reach[2], reach[1] + reach[3]
    if along >= _MIN_ALONG * across:
        return None
    text = f"the ground is seen {across / along:.1f} times as far to the sides as ahead and behind: y may be forward"
    return FrameDoubt("axes", text, "y-forward")


def _tilted(z: _Floats, radius: _Floats, quadrants: list[NDArray[np.bool_]]) -> FrameDoubt | None:
    """The ground falls from one side to the other by more than streets do."""
    low = []
    for quadrant in quadrants:
        if np.count_nonzero(quadrant) < _MIN_POINTS:
            return None
        height = float(np.percentile(z[quadrant], _LOW_PERCENTILE))
        low.append((height, float(np.median(radius[quadrant & (z <= height)]))))
    along, across = ((low[a][0] - low[b][0]) / (low[a][1] + low[b][1]) for a, b in ((0, 2), (1, 3)))
    tilt_deg = float(np.degrees(np.arctan(np.hypot(along, across))))
    if tilt_deg < _MAX_TILT_DEG:
        return None
    return FrameDoubt("tilt", f"the ground near the sensor is tilted by {tilt_deg:.0f} degrees", None)


def _quadrants(x: _Floats, y: _Floats, half_width_deg: float) -> list[NDArray[np.bool_]]:
    """Which points lie within so many degrees, at most 45, of straight ahead, left, behind and right."""
    slope = float(np.tan(np.radians(half_width_deg)))
    along_x, along_y = np.abs(y) < slope * np.abs(x), np.abs(x) < slope * np.abs(y)
    return [along_x & (x > 0), along_y & (y > 0), along_x & (x < 0), along_y & (y < 0)]
