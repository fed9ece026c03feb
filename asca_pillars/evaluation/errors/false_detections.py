"""Surroundings of false positives: height, brightness, number of points, and points beside the box.

Everything is measured on all points of the scan above the ground. A detection may
have several traits or none. The traits are the same for every class, but have different causes: points above 2.3 m at a
detected person indicate a post or a trunk, at a car a van, a wall or a hedge.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.insertion.ground_fit import Ground, cluster_labels

FEW_POINTS = 20
TALL_M = 2.3
LOW_M = 1.2
BRIGHT_REFLECTANCE = 0.5
BRIGHT_SHARE = 0.25
HOLLOW_SHARE = 0.05
LONG_M = 5.0
_FOOT_M = 0.2  # lower points may be of the ground
_MARGIN_M = 0.1
_BESIDE_M = 1.0
_AROUND_M = 12.0

TRAITS = {
    "few points": f"fewer than {FEW_POINTS} points in the box",
    "tall": f"points above the box to more than {TALL_M:g} m above the ground",
    "low": f"no point higher than {LOW_M:g} m above the ground",
    "bright": f"{BRIGHT_SHARE:.0%} of its points or more with a reflectance of {BRIGHT_REFLECTANCE:g} or more",
    "beside": f"as many points within {_BESIDE_M:g} m beside it, at its height, as in it",
    "attached": f"what it stands on is joined to points over more than {LONG_M:g} m",
    "hollow": f"at most {HOLLOW_SHARE:.0%} of its points in the middle half of its length and width",
}


@dataclass(frozen=True)
class Surroundings:
    """Statistics of the points at a detection. Metres; NaN without points above the ground.

    Attributes:
        distance_m: horizontal distance of the box's center.
        points: number in the box, widened by 0.1 m, above the ground.
        top_m: highest point above the ground over the footprint, also above the box.
        bottom_m: lowest point.
        box_top_m: top of the box, above the ground.
        reflectance: mean of the points in the box.
        bright: share of those with at least BRIGHT_REFLECTANCE.
        beside: number of points beside the box, at its height, per point in it.
        cluster_length_m, cluster_width_m: size of the rectangle around the cluster of its points.
        middle: share of its points in the middle half of length and width.
    """

    distance_m: float
    points: int
    top_m: float
    bottom_m: float
    box_top_m: float
    reflectance: float
    bright: float
    beside: float
    cluster_length_m: float
    cluster_width_m: float
    middle: float

    @property
    def traits(self) -> tuple[str, ...]:
        """Keys of TRAITS that hold."""
        holds = {
            "few points": self.points < FEW_POINTS,
            "tall": self.top_m > TALL_M,
            "low": self.top_m < LOW_M,
            "bright": self.bright >= BRIGHT_SHARE,
            "beside": self.beside >= 1,
            "attached": self.cluster_length_m > LONG_M,
            "hollow": self.middle <= HOLLOW_SHARE,
        }
        return tuple(name for name in TRAITS if holds[name])


def describe(
    points: NDArray[np.float32], ground: Ground | None, boxes: Sequence[NDArray[np.float64]]
) -> list[Surroundings]:
    """Describe the surroundings of K boxes (7,) in a scan (N, 4), metres, the sensor at the origin.

    Args:
        points: x, y, z, reflectance.
        ground: `data.insertion.ground_fit.fit_ground` of the points; without it the ground is each box's own bottom.
        boxes: boxes of detections.
    """
    return [_describe_one(points, ground, box) for box in boxes]


def _describe_one(points: NDArray[np.float32], ground: Ground | None, box: NDArray[np.float64]) -> Surroundings:
    x, y, z, length, width, height, yaw = box
    close = points[(np.abs(points[:, 0] - x) < _AROUND_M) & (np.abs(points[:, 1] - y) < _AROUND_M)].astype(np.float64)
    floor = z - height / 2 if ground is None else float(ground.heights(box[None, :2])[0])
    above = close[:, 2] - (floor if ground is None else ground.heights(close[:, :2]))
    close, above = close[above > _FOOT_M], above[above > _FOOT_M]
    offset = close[:, :2] - (x, y)
    along = np.abs(offset @ (np.cos(yaw), np.sin(yaw)))
    across = np.abs(offset @ (-np.sin(yaw), np.cos(yaw)))
    top = z + height / 2 - floor
    over = (along < length / 2 + _MARGIN_M) & (across < width / 2 + _MARGIN_M)
    at_height = above < top + _MARGIN_M
    inside = over & at_height
    ring = (along < length / 2 + _BESIDE_M) & (across < width / 2 + _BESIDE_M) & ~over & at_height
    count = int(inside.sum())
    distance = float(np.hypot(x, y))
    if not count:
        return Surroundings(distance, 0, np.nan, np.nan, top, np.nan, np.nan, np.nan, np.nan, np.nan, np.nan)
    middle = inside & (along < length / 4) & (across < width / 4)
    extent = _joined_extent(offset, inside)
    bright = float(np.mean(close[inside, 3] >= BRIGHT_REFLECTANCE))
    return Surroundings(
        distance,
        count,
        float(above[over].max()),
        float(above[over].min()),
        top,
        float(close[inside, 3].mean()),
        bright,
        float(ring.sum() / count),
        *extent,
        float(middle.sum() / count),
    )


def _joined_extent(offset: NDArray[np.float64], inside: NDArray[np.bool_]) -> tuple[float, float]:
    """Return length and width, metres, of the cluster with most points (N,) of a box, among points (N, 2)."""
    labels = cluster_labels(offset)
    own = np.bincount(labels[inside]).argmax()
    joined = offset[labels == own] if own else offset[inside]
    centered = joined - joined.mean(axis=0)
    _, axes = np.linalg.eigh(centered.T @ centered)
    width, length = np.ptp(centered @ axes, axis=0)
    return float(length), float(width)
