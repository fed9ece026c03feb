"""Height of the sensor above the ground, estimated from scans: `--sensor-height auto`.

RANSAC plane fit, robust to walls, cars and leaves among the points.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.mounting import Mounting

_DRAWS = 200
_REFITS = 3
_MIN_AREA_M2 = 10.0
_MIN_SPREAD = 1e-9  # of points across a line through them, relative, squared


def most_common_plane(
    points: NDArray[np.float64], band_m: float, max_slope: float = math.inf
) -> NDArray[np.float64] | None:
    """Fit the plane (3,) a, b, c of z = a x + b y + c with the most of points (N, 3) within `band_m` of it; metres.

    The samples are seeded: the same points give the same plane.

    Args:
        points: any frame.
        band_m: inlier distance along z.
        max_slope: sampled planes that are steeper along x or y are rejected.

    Returns:
        None where no sampled plane is valid, or the inliers are collinear.
    """
    if not len(points):
        return None
    planes = _through_triples(points[np.random.default_rng(0).integers(0, len(points), (_DRAWS, 3))])
    planes = planes[(np.abs(planes[:, :2]) < max_slope).all(axis=1)]
    if not len(planes):
        return None
    x, y, z = np.ascontiguousarray(points.T)
    heights = planes[:, :1] * x + planes[:, 1:2] * y + planes[:, 2:]
    plane = planes[(np.abs(z - heights) < band_m).sum(axis=1).argmax()]
    for _ in range(_REFITS):
        inliers = np.abs(z - plane_heights(plane, points)) < band_m
        refit = _least_squares(x[inliers], y[inliers], z[inliers])
        if refit is None:
            return None
        plane = refit
    return plane


def plane_heights(plane: NDArray[np.float64], xy_m: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Return z (...,) of a plane (3,) at (..., >=2), metres; no matrix product, see `rotations.transform_points`."""
    a, b, c = plane.tolist()
    return np.asarray(a * xy_m[..., 0].astype(np.float64) + b * xy_m[..., 1].astype(np.float64) + c)


def _through_triples(triples: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the planes (M, 3) through the triples (n, 3, 3) whose triangle is large enough in bird's-eye view."""
    (x, y, z), u, v = triples[:, 0].T, (triples[:, 1] - triples[:, 0]).T, (triples[:, 2] - triples[:, 0]).T
    area = u[0] * v[1] - u[1] * v[0]  # twice the triangle's
    regular = np.abs(area) > _MIN_AREA_M2
    divisor = area[regular]
    a = (u[2] * v[1] - u[1] * v[2])[regular] / divisor
    b = (u[0] * v[2] - u[2] * v[0])[regular] / divisor
    return np.stack([a, b, z[regular] - a * x[regular] - b * y[regular]], axis=1)


def _least_squares(
    x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Fit the plane (3,) with least squared distances along z to points, (n,) each; None if they are collinear."""
    if len(x) < 3:
        return None
    middle = x.mean(), y.mean(), z.mean()
    x, y, z = x - middle[0], y - middle[1], z - middle[2]
    xx, xy, yy, xz, yz = (x * x).sum(), (x * y).sum(), (y * y).sum(), (x * z).sum(), (y * z).sum()
    divisor = xx * yy - xy * xy
    if divisor <= _MIN_SPREAD * xx * yy:
        return None
    a, b = (xz * yy - yz * xy) / divisor, (yz * xx - xz * xy) / divisor
    return np.array([a, b, middle[2] - a * middle[0] - b * middle[1]])


NEAR_M = (3.0, 20.0)  # beyond the vehicle itself, up to where the beams become sparse
CELL_M = 1.0
BAND_M = 0.12
"""Inlier distance of the plane, which allows for camber and kerbs."""
MIN_CELLS = 40
MIN_SHARE = 0.3
"""Smallest fraction of the cells whose low point is on the plane."""
MAX_SHARE_BELOW = 0.3
MAX_TILT_DEG = 5.0
MAX_SPREAD_M = 0.3
_BY_HAND = "give the height in metres (--sensor-height 1.8, or sensor_height_m of the mounting)"


class GroundPlane(NamedTuple):
    """Ground plane near one sensor, level frame."""

    height_m: float
    """Height of the origin above the plane."""
    tilt_deg: float
    """Angle between the normal and z, degrees."""
    share: float
    """Fraction of the cells of 1 m whose low point is within BAND_M of the plane."""
    share_below: float
    """Fraction of the cells whose low point is further below it: a plane above others is not the ground."""
    cells: int
    normal: tuple[float, float, float]
    """Unit normal, upwards."""

    @property
    def doubt(self) -> str | None:
        """Reason why this may not be the ground; None if it is."""
        if self.share < MIN_SHARE or self.share_below > MAX_SHARE_BELOW:
            return f"only {self.share:.0%} of the low points lie on a plane, {self.share_below:.0%} below it"
        if self.tilt_deg > MAX_TILT_DEG:
            return f"the ground is tilted by {self.tilt_deg:.0f} degrees; give the pose of the sensor"
        return None


class NamedPoints(NamedTuple):
    """Points (N, >=3) of a scan, metres, and its name in messages."""

    name: str
    points: NDArray[Any]


class HeightEstimate(NamedTuple):
    """Height of the sensor, estimated from several scans."""

    height_m: float
    """Median over the scans."""
    spread_m: float
    """Difference between the highest and the lowest estimate."""
    share: float
    """Smallest `GroundPlane.share`."""
    scans: int
    left_out: tuple[str, ...] = ()
    """Scans without a clear ground, each with the reason."""

    def __str__(self) -> str:
        agree = "" if self.scans == 1 else f", which agree within {self.spread_m:.2f} m"
        return (
            f"{self.height_m:.2f} m above the ground, estimated from {self.scans} scan{'s' * (self.scans > 1)}{agree}: "
            f"{self.share:.0%} of the low points near the sensor lie on the plane"
            + (f"; left out: {_first_of(self.left_out)}" if self.left_out else "")
        )


def estimate_height(scans: Iterable[NDArray[Any]], mounting: Mounting | None = None) -> HeightEstimate:
    """Estimate the height above the ground of the origin of a mounting's level frame, from scans of one sensor.

    Args:
        scans: (N, >=3) finite x, y, z in metres, as they come.
        mounting: axes or pose; its height does not matter. None: x forward, y left, z up.

    Raises:
        ScanError: no scan shows a clear ground, or the scans contradict each other; says how.
    """
    return estimate_named_height((NamedPoints(f"scan {n}", scan) for n, scan in enumerate(scans, start=1)), mounting)


def estimate_named_height(
    scans: Iterable[NamedPoints], mounting: Mounting | None = None, enough: int | None = None
) -> HeightEstimate:
    """Estimate the height as `estimate_height`, from named scans, until `enough` of them show the ground.

    Raises:
        ScanError: no scan shows a clear ground, or the scans contradict each other; names one.
    """
    level = (mounting or Mounting()).level
    heights: dict[str, float] = {}
    shares, left_out = [], []
    for name, points in scans:
        plane = fit_ground_plane(level.points(points))
        doubt = "too few points near the sensor, or all on one line" if plane is None else plane.doubt
        if plane is None or doubt:
            left_out.append(f"{name}: {doubt}")
            continue
        heights[name] = plane.height_m
        shares.append(plane.share)
        if len(heights) == enough:
            break
    if not heights:
        why = f"from {_first_of(left_out)}" if left_out else "without a scan"
        raise ScanError(f"the sensor's height cannot be estimated {why}; {_BY_HAND}")
    low, high = min(heights, key=heights.__getitem__), max(heights, key=heights.__getitem__)
    spread = heights[high] - heights[low]
    if spread > MAX_SPREAD_M:
        raise ScanError(
            f"{len(heights)} scans disagree by {spread:.2f} m on the sensor's height: {heights[low]:.2f} m in {low}, "
            f"{heights[high]:.2f} m in {high}; {_BY_HAND}"
        )
    return HeightEstimate(float(np.median([*heights.values()])), spread, min(shares), len(heights), tuple(left_out))


def _first_of(left_out: Sequence[str]) -> str:
    return left_out[0] + (f" (and {len(left_out) - 1} more)" if left_out[1:] else "")


def measured_mounting(
    scans: Iterable[NDArray[Any]], mounting: Mounting | None = None
) -> tuple[Mounting, HeightEstimate]:
    """Return the mounting with the height in metres estimated from its scans (N, >=3), see `estimate_height`."""
    estimate = estimate_height(scans, mounting)
    return replace(mounting or Mounting(), sensor_height_m=estimate.height_m), estimate


def fit_ground_plane(points: NDArray[Any]) -> GroundPlane | None:
    """Fit the ground plane near the sensor: (N, >=3) level frame, metres; None: too few low points, or collinear ones.

    One low point per square metre counts, so that the dense rings near the sensor do not outvote the rest. The
    samples are seeded: the same points give the same plane.
    """
    low = _low_points(points)
    if len(low) < MIN_CELLS:
        return None
    if (plane := most_common_plane(low, BAND_M)) is None:
        return None
    above = low[:, 2] - plane_heights(plane, low)
    tilt = float(np.degrees(np.arctan(np.hypot(*plane[:2]))))
    share, below = float((np.abs(above) < BAND_M).mean()), float((above < -2 * BAND_M).mean())
    x, y, z = (np.array([-plane[0], -plane[1], 1.0]) / np.sqrt(1 + np.square(plane[:2]).sum())).tolist()
    return GroundPlane(float(-plane[2]), tilt, share, below, len(low), (x, y, z))


def _low_points(points: NDArray[Any]) -> NDArray[np.float64]:
    """Return one point (C, 3) per square metre near the sensor: the one at the tenth percentile of z."""
    xyz = points[:, :3].astype(np.float64)
    squared = np.square(xyz[:, :2]).sum(axis=1)
    ring = xyz[(squared > NEAR_M[0] ** 2) & (squared < NEAR_M[1] ** 2)]
    column, row = np.floor(ring[:, :2] / CELL_M).astype(np.int64).T
    cells = 1000 * column + row
    order = np.lexsort((ring[:, 2], cells))
    _, first, count = np.unique(cells[order], return_index=True, return_counts=True)
    return ring[order[(first + count // 10)[count >= 3]]]
