"""Firings that the image cannot show, whatever they meet: there is no need to find out."""

import numpy as np
import numpy.typing as npt

from asca_pillars.data.kitti.calibration import DEFAULT_IMAGE_SIZE_WH, Calibration
from asca_pillars.sim.sensor.lidar import Firings

MARGIN_PX = 3.0  # points are rounded to millimetres


def outside_image(firings: Firings, calib: Calibration) -> npt.NDArray[np.bool_]:
    """(K,C) firings all of whose returns lie beyond one border of the image, or behind the camera.

    What lies beyond a border is a half space (x, y, z, 1) * plane > 0, so that a ray lies there if it does at the
    nearest and at the farthest range.
    """
    u, v, depth = calib.p2 @ calib.rect_from_lidar_matrix
    width, height = DEFAULT_IMAGE_SIZE_WH
    planes = (
        -u - MARGIN_PX * depth,
        u - (width + MARGIN_PX) * depth,
        -v - MARGIN_PX * depth,
        v - (height + MARGIN_PX) * depth,
    )
    stretch = np.sqrt(1.0 + firings.slope**2)
    ends_m = np.array(firings.lidar.range_m)[:, None] / stretch  # (2,K) horizontal distances
    cos, sin = np.cos(firings.azimuth_rad), np.sin(firings.azimuth_rad)
    phase = np.stack([np.cos(firings.phase_rad), np.sin(firings.phase_rad)], axis=1)
    outside = np.zeros((len(firings.slope), len(cos)), bool)
    for x, y, z, one in planes:
        # Along a ray the product is start + rise * distance: positive at both ends if the rise exceeds -start / each.
        start, rise = z * firings.origin_z_m + one, phase @ np.stack([x * cos + y * sin, y * cos - x * sin])
        least = (-start / ends_m).max(axis=0) - z * firings.slope
        outside |= rise > least[:, None]
    return outside
