"""What the scans of a training looked like: measured once, kept in the bundle, compared with by `input_check`."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.frame_check import ground_z_m
from asca_pillars.schema import Strict


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
