"""From what each firing met to the points that the sensor reports: power, noise, loss, rounding."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .raycast import Hits
from .sensor import Firings

FADING, SPECKLE = 0.6, 0.2  # spread of the power (in logarithm) and of the reflectance from firing to firing


class Returns(NamedTuple):
    """Points in the order of KITTI's files: ring by ring from the top, each counter-clockwise from straight ahead."""

    points: npt.NDArray[np.float32]  # (N,4) x, y, z metres, reflectance 0..0.99 in steps of 0.01
    owner: npt.NDArray[np.int64]  # (N,) object index, BACKGROUND or GROUND
    ring: npt.NDArray[np.int64]  # (N,)


def measure(hits: Hits, firings: Firings, rng: np.random.Generator) -> Returns:
    """Points of one revolution.

    Random numbers are drawn for every firing, cast or not, so that a firing's noise does not depend on the others.
    """
    shape = hits.rho_m.shape
    noise = rng.standard_normal(shape, np.float32)
    fading = rng.standard_normal(shape, np.float32)
    speckle = rng.standard_normal(shape, np.float32)
    luck = rng.random(shape, np.float32)
    weak = rng.random(shape, np.float32)
    faint = rng.random(shape, np.float32)

    stretch = np.sqrt(1.0 + firings.slope**2)
    hidden = np.arange(shape[0])[:, None] >= firings.hidden_from[None]
    ring, column = np.nonzero(np.isfinite(hits.rho_m) & ~hidden)
    slant = hits.rho_m[ring, column] * stretch[ring]
    reflectance = hits.reflectance[ring, column]
    # Rough surfaces keep answering at grazing incidence: the root of the cosine, not the cosine.
    power = reflectance * np.sqrt(hits.cosine[ring, column]) / slant**2 * np.exp(FADING * fading[ring, column])
    power[weak[ring, column] < firings.weak_share] *= 0.01
    slant = slant + noise[ring, column] * firings.range_sigma_m + firings.ring_bias_m[ring]
    near, far = firings.range_m
    kept = (power > firings.lost_power) & (luck[ring, column] >= firings.loss_share)
    kept &= (slant > near) & (slant < far - 1e-3)

    ring, column, slant, reflectance, power = ring[kept], column[kept], slant[kept], reflectance[kept], power[kept]
    rho = slant / stretch[ring]
    azimuth = firings.azimuth_rad[column] + firings.phase_rad[ring]
    z = firings.origin_z_m[ring] + rho * firings.slope[ring]
    value = reflectance * firings.ring_gain[ring] * (1.0 + SPECKLE * speckle[ring, column])
    value[(power < firings.zero_power) | (value < firings.faint * faint[ring, column])] = 0.0
    value = np.floor(np.clip(value, 0.0, 0.995) * 100.0) / 100.0
    points = np.column_stack(
        [np.round(rho * np.cos(azimuth), 3), np.round(rho * np.sin(azimuth), 3), np.round(z, 3), value]
    )
    owner = hits.owner[ring, column]
    return Returns(points.astype(np.float32), owner, ring)
