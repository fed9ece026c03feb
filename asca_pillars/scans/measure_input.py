"""Statistics of training scans for the bundle."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from asca_pillars.scans.expected_input import ExpectedInput
from asca_pillars.scans.input_check import ground_z_m


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
