"""Which firings the image cannot show."""

import numpy as np
import pytest

from asca_pillars.data.kitti import in_image
from asca_pillars.sim.lidar import Lidar, draw_firings
from asca_pillars.sim.simulation import outside_image
from asca_pillars.sim.world.scene import draw_calibration


@pytest.mark.parametrize("seed", range(4))
def test_no_point_of_a_firing_outside_lies_in_the_image_and_most_others_can(seed: int) -> None:
    rng = np.random.default_rng(seed)
    firings, calib = draw_firings(Lidar(), rng, camera_only=True), draw_calibration(rng)
    outside = outside_image(firings, calib)
    azimuth = firings.azimuth_rad[None] + firings.phase_rad[:, None]
    slope = np.broadcast_to(firings.slope[:, None], azimuth.shape)
    direction = np.stack([np.cos(azimuth), np.sin(azimuth), slope], axis=-1) / np.sqrt(1 + slope**2)[..., None]
    origin = np.zeros_like(direction)
    origin[..., 2] = firings.origin_z_m[:, None]
    shown = np.zeros(outside.shape, bool)
    for slant in (2.001, 3.0, 5.0, 8.0, 15.0, 40.0, 79.9):
        shown |= in_image((origin + slant * direction).round(3), calib)
    assert not (shown & outside).any()
    assert outside.mean() > 0.2 and (shown | outside).mean() > 0.97
