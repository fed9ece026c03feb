"""Comparison of a scan with the training scans, and a check of its axes; each warning names the option to set.

A wrong reflectance scale, sensor height or axis degrades detection without an error; here it gives a warning.
The bundle stores the statistics of the training scans.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.strict import Strict
from asca_pillars.geometry.boxes import Floating, Mask, Ranges, Singles, within
from asca_pillars.scans.mounting import Mounting

_HIGHEST_M = 100.0  # larger heights of the ground are not plausible


@dataclass(frozen=True)
class ExpectedInput(Strict):
    """Statistics of the training scans: (lowest, highest) over scans."""

    points_per_scan: tuple[int, int]
    """Finite points of a scan, cropped to the camera's view if `camera_view`."""
    reflectance_mean: tuple[float, float]
    """Mean reflectance of a scan, 0..1."""
    ground_z_m: tuple[float, float] | None
    """Height of the ground near the sensor, LiDAR frame, metres (minus the sensor's height); None if no scan
    showed the ground."""
    camera_view: bool
    """True if the scans were cropped to the points in the camera's image."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("points_per_scan", 0, 2**53),
            ("reflectance_mean", 0, 1),
            ("ground_z_m", -_HIGHEST_M, _HIGHEST_M),
        ):
            ends = getattr(self, name)
            if ends is not None and not low <= ends[0] <= ends[1] <= high:
                raise ConfigError(
                    f"expected_input.{name} = {list(ends)}: must be lowest and highest in {low:g}..{high:g}"
                )

    @property
    def sensor_height_m(self) -> float | None:
        """Height of the sensor above the ground in the middle of those scans; None where no scan showed it."""
        return None if self.ground_z_m is None else -sum(self.ground_z_m) / 2


OUTSIDE_SHARE = 0.95
FAR_M, FAR_SHARE = 1000.0, 0.05
"""Distance in metres, and the largest fraction of a LiDAR's points that may be further away."""
BEHIND_SHARE = 0.2
"""Smallest fraction of points behind, beyond BODY_M: about 0.5 in a revolution, 0.1 in a field of view of 200 deg."""
BODY_M = 3.0
"""Nearer returns are mostly of the vehicle itself."""
SAMPLE_POINTS = 8_192  # enough for a mean and a percentile, in a tenth of a millisecond
_FRAME_STEP = 2  # of the sample; angles and ranges are slower to compute

TOLERANCE_M = 0.5
"""A ground that differs by more from the expected height means another sensor height, not another road."""

_SCALES = (100.0, 255.0, 65535.0)


class InputWarning(NamedTuple):
    """Difference between a scan and the training scans; `about` is its kind, `text` the message for users."""

    about: str
    text: str


def check_input(
    points: Singles,
    ranges: Ranges,
    expected: ExpectedInput,
    mounting: Mounting | None = None,
    *,
    around: bool = False,
) -> list[InputWarning]:
    """Compare a scan with the training scans, and with where the detector looks.

    Args:
        points: (N, 4) finite x, y, z in metres, model's frame, and reflectance.
        ranges: where the detector looks.
        expected: statistics of the training scans.
        mounting: the mounting by which the points came into that frame.
        around: whether the detector looks in every direction.
    """
    mounting = mounting or Mounting()
    fewest, most = expected.points_per_scan
    if len(points) < fewest / 10:
        text = f"{len(points)} points, the training scans had {fewest} to {most}"
        return [InputWarning("points", text)]  # too few for the other checks
    # Contiguous columns, as they are read: NumPy is slow along rows of four.
    sample = np.ascontiguousarray(points[:: max(1, len(points) // SAMPLE_POINTS)].T).T
    if far := _far_warning(sample):
        return [far]  # the other checks would repeat it
    ground = ground_z_m(sample)
    axes = check_axes(sample[::_FRAME_STEP], ground)
    warnings = [_reflectance_warning(sample[:, 3], expected)]
    if axes is not None:
        warnings.append(InputWarning(axes.about, f"{axes.text}: {_axes_remedy(axes.axes, mounting)}"))
    if axes is None or axes.about not in ("upside down", "tilt"):  # otherwise the height is meaningless
        warnings.append(_height_warning(ground, expected, mounting))
    outside = 1 - float(within(sample, ranges).mean())
    if outside > OUTSIDE_SHARE and axes is None:
        text = (
            f"{100 * outside:.1f} % of the points lie outside the grid, where x is forward, y left, z up, in metres: "
            "state other axes (--axes)"
        )
        warnings.append(InputWarning("range", text))
    elif not around:
        warnings.append(_behind_warning(sample[::_FRAME_STEP], ranges))
    return [warning for warning in warnings if warning]


def _far_warning(sample: Singles) -> InputWarning | None:
    """Return a warning if the unit is not metres, or the points are in a map's frame."""
    sideways = sample[:, :2]
    share = np.count_nonzero((np.abs(sideways) > FAR_M).any(axis=1)) / len(sample)
    if share <= FAR_SHARE:
        return None
    low, middle, high = np.percentile(sideways.astype(np.float64), (5, 50, 95), axis=0)
    begins = f"{100 * share:.0f} % of the points lie more than {FAR_M / 1000:g} km away"
    if np.abs(middle).max() > (high - low).max():
        text = (
            f"{begins}, around x = {middle[0]:.0f}, y = {middle[1]:.0f}: coordinates have to be those of the sensor's "
            "frame, not of a map: subtract the sensor's position before they are stored as float32"
        )
    else:
        text = f"{begins}: coordinates have to be in metres: divide millimetres by 1000, centimetres by 100"
    return InputWarning("range", text)


def _reflectance_warning(reflectance: Singles, expected: ExpectedInput) -> InputWarning | None:
    low, high = expected.reflectance_mean
    largest, mean = float(reflectance.max()), float(reflectance.mean(dtype=np.float64))
    if largest > 1.5:
        scale = next((scale for scale in _SCALES if largest <= scale), _SCALES[-1])
        text = (
            f"reflectance reaches {largest:.4g}, the model was trained on 0..1: divide it by {scale:g} "
            f"(--reflectance-scale {scale:g} for files)"
        )
        return InputWarning("reflectance", text)
    if largest == 0 < low:
        text = "the scan has no reflectance, all are 0: the model was trained with it, so export it with intensity"
        return InputWarning("reflectance", text)
    if not low / 3 <= mean <= high * 3:
        text = (
            f"mean reflectance is {mean:.3g}, in training it was {low:.3g} to {high:.3g}: rescale it to 0..1 "
            "(--reflectance-scale for files)"
        )
        return InputWarning("reflectance", text)
    return None


def _height_warning(ground: float | None, expected: ExpectedInput, mounting: Mounting) -> InputWarning | None:
    if ground is None or expected.ground_z_m is None:
        return None
    low, high = expected.ground_z_m
    if low - TOLERANCE_M <= ground <= high + TOLERANCE_M:
        return None
    lifted_m = 0.0
    if mounting.sensor_height_m is not None and expected.sensor_height_m is not None:
        lifted_m = mounting.sensor_height_m - expected.sensor_height_m
    height_m = lifted_m - ground + 0.0  # avoids -0
    text = (
        f"the ground near the sensor lies at z = {ground:.2f} m, in training at {low:.2f} to {high:.2f} m: "
        f"state the height above the ground (--sensor-height {height_m:.2f} or auto)"
    )
    return InputWarning("height", text)


def share_behind(points: Singles, model_ranges: Ranges) -> float:
    """Return the share of the points (N, >=2), metres, LiDAR frame, in directions that the model does not cover.

    It is 0 below BEHIND_SHARE and for a sensor that looks to one side, whose scans need no look around.
    """
    away = points[np.abs(points[:, :2]).max(axis=1, initial=0) > BODY_M]
    share = float(model_ranges.behind(away).mean()) if len(away) else 0.0
    one_sided = share >= BEHIND_SHARE and np.hypot(*_mean_direction(*away[:, :2].T)) >= _SECTOR_LENGTH
    return 0.0 if share < BEHIND_SHARE or one_sided else share


def _behind_warning(points: Singles, model_ranges: Ranges) -> InputWarning | None:
    share = share_behind(points, model_ranges)
    if not share:
        return None
    text = f"{share:.0%} of the points lie behind the sensor, where the model does not look: look around (--around)"
    return InputWarning("view", text)


def _axes_remedy(axes: str | None, mounting: Mounting) -> str:
    if axes is None:
        return "state how the sensor is tilted (--pose)"
    if not mounting.level.is_identity:
        return "check the axes or the pose that were given"
    return f"if so, state the axes (--axes {axes})"


_AXES = ("x,y,z", "y,-x,z", "-x,-y,z", "-y,x,z")
"""Axes (forward, left, up) of a scan for each quadrant that its forward direction may be in, see `Mounting.axes`."""

_EDGE_PERCENTILES = (5, 20, 80, 95)
_SHARP_M = 0.5
"""Largest distance between the outer two percentiles at the ground, a sharp edge; walls and trees have none."""
_GROUND_ABOVE_M = 1.0

_SECTOR_LENGTH = 0.6
"""Length of the mean unit vector towards the points: 0 for a whole revolution, 0.92 for a camera's field of view."""
_MAX_OFF_AHEAD_DEG = 45.0

_REACH_M = (3.0, 60.0)
_GROUND_BAND_M = 0.75
_HALF_WIDTH_DEG = 25.0
_MIN_POINTS = 20
_MIN_ALONG = 0.85
"""Least ratio of the median ground range ahead and behind to that at the sides: streets are visible further along.
No simulated revolution of 200 is below it; turned by a quarter, 90 % of them are."""

_MAX_TILT_DEG = 6.0
_RING_M = (4.0, 20.0)
"""Beyond the vehicle's own roof, up to where the beams become sparse."""
_LOW_PERCENTILE = 10.0
"""Lower points are ditches and reflections."""
_MIN_GROUND_POINTS = 50


class AxesWarning(NamedTuple):
    """Sign of wrong axes: `about` is its kind, `axes` those that would correct it, or None."""

    about: str
    text: str
    axes: str | None


def ground_z_m(points: Singles) -> float | None:
    """Return the height of the ground around the sensor, metres: a low percentile of z in a near ring of points.

    Takes finite points (N, >=3) in the LiDAR frame; None if the ring has too few of them.
    """
    x, y = points[:, 0], points[:, 1]
    with np.errstate(over="ignore"):  # infinite distances are not near
        squared_range = x * x + y * y
    ring = np.flatnonzero((squared_range > _RING_M[0] ** 2) & (squared_range < _RING_M[1] ** 2))
    ring_z = points[:, 2].take(ring)
    return _percentile(np.sort(ring_z), _LOW_PERCENTILE) if len(ring_z) >= _MIN_GROUND_POINTS else None


def check_axes(points: Singles, ground_z_m: float | None) -> AxesWarning | None:
    """Check the axes of a scan: the first of z pointing down, turned axes and a tilt; None if they look right.

    Undetectable are half a turn, a mirror image, and a quarter turn on a square or a crossing.

    Args:
        points: (N, >=3) finite x, y, z in metres, in what should be the LiDAR frame; some thousands are enough.
        ground_z_m: height of the ground near the sensor, if it is visible.
    """
    x, y, z = points[:, :3].T
    with np.errstate(over="ignore"):  # infinite distances are not near
        radius = np.hypot(x, y)
    ring = (radius > _RING_M[0]) & (radius < _RING_M[1])
    if warning := _upside_down(z[ring]):
        return warning
    if warning := _sector(x, y, radius):
        return warning
    if ground_z_m is None:
        return None
    ground = (z < ground_z_m + _GROUND_BAND_M) & (radius > _REACH_M[0]) & (radius < _REACH_M[1])
    if warning := _across(radius[ground], _quadrants(x[ground], y[ground], _HALF_WIDTH_DEG)):
        return warning
    return _tilted(z[ring], radius[ring], _quadrants(x[ring], y[ring], 45.0))


def _upside_down(z: Floating) -> AxesWarning | None:
    """Return a warning if the points end sharply above the sensor, as at the ground, and gradually below it."""
    if len(z) < _MIN_POINTS:
        return None
    ordered = np.sort(z)
    lowest, low, high, highest = (_percentile(ordered, percent) for percent in _EDGE_PERCENTILES)
    if highest < _GROUND_ABOVE_M or highest - high > min(_SHARP_M, low - lowest):
        return None
    text = f"the points near the sensor end at z = {highest:.1f} m as at the ground: z may point down"
    return AxesWarning("upside down", text, "x,-y,-z")


def _sector(x: Floating, y: Floating, radius: Floating) -> AxesWarning | None:
    """Return a warning if the points fill a sector that is not ahead."""
    away = radius > 0
    if not away.any():
        return None
    mean_x, mean_y = _mean_direction(x[away], y[away])
    middle_deg = float(np.degrees(np.arctan2(mean_y, mean_x)))
    if np.hypot(mean_x, mean_y) < _SECTOR_LENGTH or abs(middle_deg) < _MAX_OFF_AHEAD_DEG:
        return None
    quadrant = round(middle_deg / 90) % 4
    text = f"the points fill a sector about {middle_deg:+.0f} degrees, and ahead is 0: x may not be forward"
    return AxesWarning("axes", text, _AXES[quadrant])


def _mean_direction(x: Floating, y: Floating) -> tuple[float, float]:
    """Return the mean unit vector towards points, (N,) each, none of them at the origin."""
    with np.errstate(over="ignore"):  # infinite points have no direction
        radius = np.hypot(x, y)
    return float((x / radius).mean()), float((y / radius).mean())


def _across(radius: Floating, quadrants: list[Mask]) -> AxesWarning | None:
    """Return a warning if the ground is visible further to the sides than ahead and behind."""
    reach = []
    for quadrant in quadrants:
        if np.count_nonzero(quadrant) < _MIN_POINTS:
            return None
        reach.append(_percentile(np.sort(radius[quadrant]), 50.0))
    along, across = reach[0] + reach[2], reach[1] + reach[3]
    if along >= _MIN_ALONG * across:
        return None
    text = f"the ground is seen {across / along:.1f} times as far to the sides as ahead and behind: y may be forward"
    return AxesWarning("axes", text, "y-forward")


def _tilted(z: Floating, radius: Floating, quadrants: list[Mask]) -> AxesWarning | None:
    """Return a warning if the ground is steeper from one side to the other than streets are."""
    low = []
    for quadrant in quadrants:
        if np.count_nonzero(quadrant) < _MIN_POINTS:
            return None
        height = _percentile(np.sort(z[quadrant]), _LOW_PERCENTILE)
        low.append((height, _percentile(np.sort(radius[quadrant & (z <= height)]), 50.0)))
    along, across = ((low[a][0] - low[b][0]) / (low[a][1] + low[b][1]) for a, b in ((0, 2), (1, 3)))
    tilt_deg = float(np.degrees(np.arctan(np.hypot(along, across))))
    if tilt_deg < _MAX_TILT_DEG:
        return None
    return AxesWarning("tilt", f"the ground near the sensor is tilted by {tilt_deg:.0f} degrees", None)


def _quadrants(x: Floating, y: Floating, half_width_deg: float) -> list[Mask]:
    """Return masks of the points within an angle, at most 45 degrees, of ahead, left, behind and right."""
    slope = float(np.tan(np.radians(half_width_deg)))
    along_x, along_y = np.abs(y) < slope * np.abs(x), np.abs(x) < slope * np.abs(y)
    return [along_x & (x > 0), along_y & (y > 0), along_x & (x < 0), along_y & (y < 0)]


def _percentile(ordered: Floating, percent: float) -> float:
    """Return `np.percentile` of ascending values (n,), n at least 1; ten times as fast for a thousand of them."""
    place, part = divmod(percent / 100 * (len(ordered) - 1), 1)
    low, high = float(ordered[int(place)]), float(ordered[min(int(place) + 1, len(ordered) - 1)])
    return low + part * (high - low)


def measure_expected_input(scans: Iterable[NDArray[np.float32]], camera_view: bool) -> ExpectedInput:
    """Measure training scans.

    Args:
        scans: each (N, 4) x, y, z in metres, LiDAR frame, and reflectance 0..1, empty ones are left out; as the
            network gets them before augmentation, hence cropped if `camera_view`. Read once, one after the other.
        camera_view: whether they are cropped to the camera's image.

    Raises:
        ValueError: there is no scan with a point.
    """
    measured = [(len(points), float(points[:, 3].mean()), ground_z_m(points)) for points in scans if len(points)]
    grounds = [ground for _, _, ground in measured if ground is not None]
    return ExpectedInput(
        points_per_scan=(min(m[0] for m in measured), max(m[0] for m in measured)),
        reflectance_mean=(min(m[1] for m in measured), max(m[1] for m in measured)),
        ground_z_m=(min(grounds), max(grounds)) if grounds else None,
        camera_view=camera_view,
    )
