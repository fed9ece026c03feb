"""What the scans of a training looked like, and how far another scan is from them.

A wrong reflectance scale or sensor height ruins detection without any error; here it becomes a sentence.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.frame_report import ScanCounts
from asca_pillars.schema import Strict

OUTSIDE_SHARE = 0.95
SAMPLE_POINTS = 8_192  # as good as all of them for a mean and a percentile, at a tenth of a millisecond

RING_M = (4.0, 20.0)  # beyond the vehicle's own roof, before the beams become sparse
PERCENTILE = 10.0  # below it lie ditches and reflections
MIN_POINTS = 50

TOLERANCE_M = 0.5
"""A ground further than this from where a detector expects it is another sensor height, not another road."""


@dataclass(frozen=True)
class ExpectedInput(Strict):
    """What the training scans looked like: (lowest, highest) over scans."""

    points_per_scan: tuple[int, int]
    """Finite points of a scan, cropped to the camera's view if `camera_view`."""
    reflectance_mean: tuple[float, float]
    """Mean reflectance of a scan, 0..1."""
    ground_z_m: tuple[float, float] | None
    """Height of the ground near the sensor, LiDAR frame, metres (minus the sensor's height); None where no scan
    showed it."""
    camera_view: bool
    """Whether the scans were cropped to the points in the camera's image."""

    @property
    def sensor_height_m(self) -> float | None:
        """Height of the sensor above the ground in the middle of those scans; None where no scan showed it."""
        return None if self.ground_z_m is None else -sum(self.ground_z_m) / 2


class InputWarning(NamedTuple):
    """One way in which a scan is far from the training scans; `about` names the way, `text` is for people."""

    about: str
    text: str


def ground_z_m(points: NDArray[np.float32]) -> float | None:
    """Height of the ground around the sensor, metres: a low percentile of z in a near ring of the points.

    Takes finite points (N, >=3) in the LiDAR frame; None if the ring holds too few of them to tell.
    """
    x, y = points[:, 0], points[:, 1]
    with np.errstate(over="ignore"):  # infinitely far is not near
        squared_range = x * x + y * y
    ring = np.flatnonzero((squared_range > RING_M[0] ** 2) & (squared_range < RING_M[1] ** 2))
    near_z = points[:, 2].take(ring)
    return float(np.percentile(near_z, PERCENTILE)) if len(near_z) >= MIN_POINTS else None


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


def check_input(points: NDArray[np.float32], counts: ScanCounts, expected: ExpectedInput) -> list[InputWarning]:
    """Compare a scan with the training scans.

    Args:
        points: (N, 4) finite x, y, z in metres, LiDAR frame, and reflectance.
        counts: what became of them on the detector's grid.
        expected: of the training scans.
    """
    fewest, most = expected.points_per_scan
    if len(points) < fewest / 10:
        text = f"{len(points)} points, the training scans had {fewest} to {most}"
        return [InputWarning("points", text)]  # too few to say anything else
    # Column by column in memory, which is how it is read: NumPy is slow along rows of four.
    sample = np.ascontiguousarray(points[:: max(1, len(points) // SAMPLE_POINTS)].T).T
    warnings = [_reflectance_warning(sample[:, 3], expected), _height_warning(sample, expected)]
    if counts.points_outside > OUTSIDE_SHARE * counts.points:
        share = 100 * counts.points_outside / counts.points
        text = f"{share:.1f} % of the points lie outside the grid: x is forward, y left, z up, in metres"
        warnings.append(InputWarning("range", text))
    return [warning for warning in warnings if warning]


def _reflectance_warning(reflectance: NDArray[np.float32], expected: ExpectedInput) -> InputWarning | None:
    low, high = expected.reflectance_mean
    largest, mean = float(reflectance.max()), float(reflectance.mean(dtype=np.float64))
    if largest > 1.5:
        scale = 255 if largest <= 255 else 65535
        text = f"reflectance reaches {largest:.4g}, the model was trained on 0..1: divide it by {scale}"
        return InputWarning("reflectance", text)
    if not low / 3 <= mean <= high * 3:
        text = f"mean reflectance is {mean:.3g}, in training it was {low:.3g} to {high:.3g}: rescale it to 0..1"
        return InputWarning("reflectance", text)
    return None


def _height_warning(points: NDArray[np.float32], expected: ExpectedInput) -> InputWarning | None:
    ground = ground_z_m(points)
    if ground is None or expected.ground_z_m is None:
        return None
    low, high = expected.ground_z_m
    if low - TOLERANCE_M <= ground <= high + TOLERANCE_M:
        return None
    text = (
        f"the ground near the sensor lies at z = {ground:.2f} m, in training at {low:.2f} to {high:.2f} m: "
        f"add {(low + high) / 2 - ground:+.2f} m to z"
    )
    return InputWarning("height", text)
