"""From what each firing met to the points that the sensor reports: power, edges, noise, loss, rounding."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from asca_pillars.sim.casting.raycast import Hits
from asca_pillars.sim.sensor.firing_reports import Lasers, Met, Receiver, report_firings
from asca_pillars.sim.sensor.lidar import Firings


class Returns(NamedTuple):
    """Points in the order of KITTI's files: ring by ring from the top, each counter-clockwise from straight ahead."""

    points: npt.NDArray[np.float32]  # (N,4) x, y, z metres, reflectance 0..0.99 in steps of 0.01
    owner: npt.NDArray[np.int32]  # (N,) object index, BACKGROUND or GROUND
    ring: npt.NDArray[np.int64]  # (N,)


def measure(hits: Hits, firings: Firings, rng: np.random.Generator) -> Returns:
    """Points of one revolution. A firing's noise depends on its ring and column, not on which others are cast."""
    lidar = firings.lidar
    near_m, far_m = lidar.range_m
    lasers = Lasers(
        slope=firings.slope,
        stretch=np.sqrt(1.0 + firings.slope**2),
        origin_z_m=firings.origin_z_m,
        cos_phase=np.cos(firings.phase_rad),
        sin_phase=np.sin(firings.phase_rad),
        range_bias_m=firings.ring_bias_m,
        gain=firings.ring_gain,
        reflectance_sigma=firings.reflectance_sigma,
        faint=firings.faint,
        near_fade=firings.near_fade,
        cos_azimuth=np.cos(firings.azimuth_rad),
        sin_azimuth=np.sin(firings.azimuth_rad),
        number=firings.number,
    )
    receiver = Receiver(
        lost_power=firings.lost_power,
        zero_power=firings.zero_power,
        loss_share=firings.loss_share,
        zero_share=float(lidar.zero_share),
        near_m=float(near_m),
        far_m=float(far_m) - 1e-3,
        range_sigma_m=firings.range_sigma_m,
        response=float(lidar.response),
        dark_offset=float(lidar.dark_offset),
        focus_m=float(lidar.focus_m),
        fade_m=float(lidar.fade_m),
        sigma_share=float(lidar.reflectance_sigma_share),
        split_share=float(lidar.beam_split_share),
        split_lost_share=float(lidar.split_lost_share),
        columns_per_turn=firings.columns_per_turn,
    )
    met = Met(
        rho_m=np.ascontiguousarray(hits.rho_m, np.float64),
        cosine=np.ascontiguousarray(hits.cosine, np.float32),
        reflectance=np.ascontiguousarray(hits.reflectance, np.float32),
        owner=np.ascontiguousarray(hits.owner, np.int32),
        hidden=firings.hidden | firings.outside,
    )
    return Returns(*report_firings(met, lasers, receiver, int(rng.integers(1 << 62))))
