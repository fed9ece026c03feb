"""What the scans look like that a model is trained on; the runtime compares those that it gets."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.sensor_height import ground_z_m
from asca_pillars.schema import Strict


@dataclass(frozen=True)
class ExpectedInput(Strict):
    """What the training scans looked like: (lowest, highest) over scans.

    Attributes:
        points_per_scan: finite points of a scan.
        reflectance_mean: mean reflectance of a scan, 0..1.
        ground_z_m: height of the ground near the sensor, LiDAR frame, metres (minus the sensor's height);
            None where no training scan showed it.
        camera_view: whether the scans were cut to what KITTI's camera sees.
    """

    points_per_scan: tuple[int, int]
    reflectance_mean: tuple[float, float]
    ground_z_m: tuple[float, float] | None
    camera_view: bool


def expected_input(scans: Iterable[NDArray[np.float32]], camera_view: bool) -> ExpectedInput:
    """Measure training scans, each (N, 4) x, y, z in metres and reflectance 0..1, as the network sees them.

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
