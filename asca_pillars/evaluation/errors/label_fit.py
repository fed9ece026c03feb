"""Fit of labelled boxes to the points of their objects, without a detector.

Two datasets whose labels fit their points differently train different boxes. Compare, for example, a
simulated dataset with a real one, or the drives of a real one with each other.

Everything is measured along a box's own axes. The ray-facing axis is the heading or its opposite, whichever points away
from the sensor: along it the near face comes first and the far face last. Objects of at least VEHICLE_LENGTH_M are
measured end-on only, where the visible flank and the visible end separate length and width; for smaller ones, which
are visible as a whole, the range is measured.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.boxes import wrap_angle

MAX_RANGE_M = 30.0
MAX_REAR_RANGE_M = 25.0
VEHICLE_LENGTH_M = 2.5
END_ON_DEG = 18.0
MIN_POINTS = 25
MIN_DENSE_POINTS = 80
"""Least number of points for an extreme percentile."""

STATISTICS = {
    "flank_end": "end of the visible flank - far face (97th percentile of the low points, end-on)",
    "upper_end": "last points above 0.6 of the height - near face, as a share of the length (from behind)",
    "roof_end": "last points between 0.8 and 0.9 of the height - near face (from behind)",
    "roof_length": "length of the visible roof (above 0.8 of the height, 5th to 95th percentile, end-on)",
    "nearest_point": "nearest point - near face (end-on)",
    "rear_width": "visible width of the near end - width (end-on, 0.35 to 0.8 m above the bottom)",
    "top_97": "97th percentile of the points' height - height (end-on)",
    "top": "highest point - height (end-on)",
    "low_inside": "share with 5 or more low points inside, beyond the middle (end-on)",
    "range_5": "5th percentile of the points' range - range of the center",
    "range_50": "median of the points' range - range of the center",
    "range_95": "95th percentile of the points' range - range of the center",
    "range_spread": "range of the farthest point - range of the nearest",
}
"""Names of the columns of `label_fit`. Metres, except for the two shares."""


class _BoxPoints(NamedTuple):
    """Points (N,) along a box's axes, metres: from its center, and above its bottom; and their range from the center's.

    Attributes:
        along: positive towards the far face.
        across: positive to the left of that axis.
        up: height above the bottom.
        depth: along the line of sight.
    """

    along: NDArray[np.float64]
    across: NDArray[np.float64]
    up: NDArray[np.float64]
    depth: NDArray[np.float64]

    def where(self, mask: NDArray[np.bool_]) -> "_BoxPoints":
        return _BoxPoints(*(values[mask] for values in self))


def label_fit(points: NDArray[np.floating], boxes: NDArray[np.floating]) -> NDArray[np.float64]:
    """Measure labels against points: (N, >= 3), (M, 7) -> (M, len(STATISTICS)), metres or shares.

    A statistic that cannot be measured is NaN: too far away, too few points, or not end-on. Leave out objects that
    are occluded or truncated.

    Args:
        points: x, y, z in metres, the sensor at the origin.
        boxes: labelled boxes in the same frame.
    """
    result = np.full((len(boxes), len(STATISTICS)), np.nan)
    for row, box in zip(result, boxes.astype(np.float64), strict=True):
        distance = float(np.hypot(box[0], box[1]))
        if not 0 < distance <= MAX_RANGE_M:
            continue
        crop = _points_near(points, box)
        values: dict[str, float] = {}
        if box[3] < VEHICLE_LENGTH_M:
            values = _range_statistics(crop, box)
        elif view_angle_deg(box[None])[0] < END_ON_DEG:
            values = _end_on_statistics(crop, box, distance)
        row[:] = [values.get(name, np.nan) for name in STATISTICS]
    return result


def view_angle_deg(boxes: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the angle between heading and line of sight of boxes (N, 7) seen from the origin: (N,) degrees.

    0 is end-on, from the front or the rear; 90 is side-on.
    """
    bearing = np.arctan2(boxes[:, 1], boxes[:, 0])
    aside = np.abs(wrap_angle(boxes[:, 6].astype(np.float64) - bearing))
    return np.rad2deg(np.minimum(aside, np.pi - aside))


def _points_near(points: NDArray[np.floating], box: NDArray[np.float64]) -> _BoxPoints:
    """Crop the points to the surroundings of a box."""
    center, line = box[:2], box[:2] / np.hypot(box[0], box[1])
    axis = np.array([np.cos(box[6]), np.sin(box[6])])
    axis = -axis if axis @ center < 0 else axis
    reach = np.hypot(box[3], box[4]) / 2 + 1.0
    close = points[(np.abs(points[:, 0] - box[0]) < reach) & (np.abs(points[:, 1] - box[1]) < reach), :3]
    offset = close[:, :2].astype(np.float64) - center
    up = close[:, 2] - (box[2] - box[5] / 2)
    return _BoxPoints(offset @ axis, offset @ np.array([-axis[1], axis[0]]), up, offset @ line)


def _range_statistics(points: _BoxPoints, box: NDArray[np.float64]) -> dict[str, float]:
    length, width, height = box[3:6]
    inside = (np.abs(points.along) < length / 2 + 0.15) & (np.abs(points.across) < width / 2 + 0.15)
    inside &= (points.up > 0.1) & (points.up < height + 0.1)
    depth = points.depth[inside]
    if len(depth) < MIN_POINTS:
        return {}
    values = {f"range_{share}": float(np.percentile(depth, share)) for share in (5, 50, 95)}
    return values | {"range_spread": float(np.ptp(depth))}


def _end_on_statistics(points: _BoxPoints, box: NDArray[np.float64], distance_m: float) -> dict[str, float]:
    length, width, height = box[3:6]
    inside = (np.abs(points.along) < length / 2 + 0.5) & (np.abs(points.across) < width / 2 + 0.35)
    points = points.where(inside & (points.up > 0.25) & (points.up < height + 0.2))
    low_beyond = (points.up < 0.6 * height) & (points.along > 0)
    flank = np.abs(points.across) >= width / 2 - 0.25
    values = {
        "flank_end": _percentile(points.along[low_beyond & flank], 97) - length / 2,
        "low_inside": float((low_beyond & ~flank).sum() >= 5),
    }
    if len(points.along) >= MIN_POINTS:
        values["nearest_point"] = float(points.along.min() + length / 2)
        roof = points.up > 0.8 * height
        if _heads_away(box):
            upper = points.along[points.up > 0.6 * height]
            values["upper_end"] = (_last(upper) + length / 2) / length
            values["roof_end"] = _last(points.along[roof & (points.up < 0.9 * height)]) + length / 2
        values["roof_length"] = _percentile(points.along[roof], 95) - _percentile(points.along[roof], 5)
    if len(points.along) > MIN_DENSE_POINTS:
        values["top_97"] = float(np.percentile(points.up, 97) - height)
        values["top"] = float(points.up.max() - height)
        bumper = points.across[(points.up > 0.35) & (points.up < 0.8) & (points.along < 0.8 - length / 2)]
        if len(bumper) > 20 and distance_m < MAX_REAR_RANGE_M:
            values["rear_width"] = float(np.ptp(np.percentile(bumper, [1, 99])) - width)
    return values


def _heads_away(box: NDArray[np.float64]) -> bool:
    return bool(np.cos(box[6]) * box[0] + np.sin(box[6]) * box[1] > 0)


def _last(values: NDArray[np.float64]) -> float:
    """Return the third largest value, since one or two points may be outliers; NaN for fewer than five values."""
    return float(np.sort(values)[-3]) if len(values) > 4 else float("nan")


def _percentile(values: NDArray[np.float64], share: float) -> float:
    """Return a percentile; NaN for fewer than five values."""
    return float(np.percentile(values, share)) if len(values) > 4 else float("nan")
