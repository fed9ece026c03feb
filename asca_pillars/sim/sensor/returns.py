"""From what each firing met to the points that the sensor reports: power, edges, noise, loss, rounding."""

from statistics import NormalDist
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from asca_pillars.sim.casting.raycast import Hits
from asca_pillars.sim.sensor.lidar import Firings

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Owners = npt.NDArray[np.int32]

FADING = 0.5  # spread of the power from firing to firing, in logarithm
PIVOT = 0.4  # the reflectance that the response leaves as it is
UPDOWN_SPLIT = 0.3  # rings lie farther apart than firings: a footprint leans over fewer of their edges
EDGE_M = 0.3  # less is a slant, not an edge
PULSE_M = 0.6  # nearer together, two surfaces make one return
BETWEEN_SHARE, BETWEEN_M = 0.1, 5.0  # how often two echoes farther apart than that still do, and up to which distance

_LEVELS = 4096
_NORMAL = np.array([NormalDist().inv_cdf((i + 0.5) / _LEVELS) for i in range(_LEVELS)])


class Returns(NamedTuple):
    """Points in the order of KITTI's files: ring by ring from the top, each counter-clockwise from straight ahead."""

    points: npt.NDArray[np.float32]  # (N,4) x, y, z metres, reflectance 0..0.99 in steps of 0.01
    owner: Owners  # (N,) object index, BACKGROUND or GROUND
    ring: Ints  # (N,)


class _Echoes(NamedTuple):
    """What the firings that met something get back, before noise."""

    slant_m: Floats  # (N,)
    cosine: Floats  # (N,)
    reflectance: Floats  # (N,)
    owner: Owners  # (N,)
    share: Floats  # (N,) of the beam's power that met it; 0 for an echo that is lost


def measure(hits: Hits, firings: Firings, rng: np.random.Generator) -> Returns:
    """Points of one revolution.

    Random numbers are drawn for every firing, cast or not, so that a firing's noise does not depend on the others.
    """
    lidar = firings.lidar
    # Two words hold all the chance of a firing: draws of 16 bits are fine enough, and cheap.
    chance = rng.integers(0, 2**64, (*hits.rho_m.shape, 2), np.uint64)
    ring, column = np.nonzero(np.isfinite(hits.rho_m) & ~firings.hidden)
    draws = chance[ring, column].view(np.uint16).T  # (8,N)
    noise, fading, speckle = _NORMAL[draws[:3] // (65536 // _LEVELS)]
    luck, faint, lean, fate = draws[3:7] / 65536.0
    stretch = np.sqrt(1.0 + firings.slope**2)
    echoes = _split_at_edges(hits, firings, ring, column, stretch, lean, fate)

    # Rough surfaces keep answering at grazing incidence: the root of the cosine, not the cosine.
    power = echoes.reflectance * np.sqrt(echoes.cosine) / echoes.slant_m**2 * echoes.share * np.exp(FADING * fading)
    slant = echoes.slant_m + noise * firings.range_sigma_m + firings.ring_bias_m[ring]
    near, far = lidar.range_m
    kept = (power > firings.lost_power) & (luck >= firings.loss_share) & (slant > near) & (slant < far - 1e-3)

    value = (PIVOT + lidar.dark_offset) * (echoes.reflectance / PIVOT) ** lidar.response - lidar.dark_offset
    value *= firings.ring_gain[ring] * _fade(echoes.slant_m, firings, ring)
    value += (firings.reflectance_sigma[ring] + lidar.reflectance_sigma_share * value) * speckle
    weak = (power < firings.zero_power) | (value < firings.faint[ring] * faint)
    value[weak | (luck > 1.0 - lidar.zero_share)] = 0.0
    value = np.floor(np.clip(value, 0.0, 0.995) * 100.0) / 100.0

    rho = slant / stretch[ring]
    azimuth = (firings.azimuth_rad[column] + firings.phase_rad[ring]).astype(np.float32)
    z = firings.origin_z_m[ring] + rho * firings.slope[ring]
    points = np.empty((len(rho), 4), np.float32)
    points[:, 0], points[:, 1], points[:, 2] = rho * np.cos(azimuth), rho * np.sin(azimuth), z
    np.round(points[:, :3], 3, out=points[:, :3])
    points[:, 3] = value
    return Returns(points[kept], echoes.owner[kept], ring[kept])


def _fade(slant_m: Floats, firings: Firings, ring: Ints) -> Floats:
    """Reported over true reflectance: strongest where the lens is focused."""
    lidar = firings.lidar
    fade = np.ones_like(slant_m)
    if lidar.fade_m > 0:
        beyond = np.maximum(slant_m - lidar.focus_m, 0.0) / lidar.fade_m
        before = np.clip(1.0 - slant_m / lidar.focus_m, 0.0, 1.0)
        fade = np.exp(-(beyond**1.3)) * (1.0 - firings.near_fade[ring] * before**1.5)
    return fade


def _split_at_edges(
    hits: Hits, firings: Firings, ring: Ints, column: Ints, stretch: Floats, lean: Floats, fate: Floats
) -> _Echoes:
    """The echoes of firings (ring, column), of which some lean over an edge to a neighboring firing's surface.

    `lean` in 0..1 says to which neighbor and how far, `fate` in 0..1 what becomes of two echoes: none, one between
    both, or the stronger of them.
    """
    lidar = firings.lidar
    slant = hits.rho_m[ring, column] * stretch[ring]
    at = ring * len(firings.azimuth_rad) + column
    cosine, reflectance, owner = (of.ravel()[at] for of in (hits.cosine, hits.reflectance, hits.owner))
    echoes = _Echoes(slant, cosine.astype(float), reflectance.astype(float), owner, np.ones(len(ring)))
    sideways, updown = lidar.beam_split_share, lidar.beam_split_share * UPDOWN_SPLIT
    aside = np.minimum(lean, 1.0 - lean)
    some = np.flatnonzero(aside < sideways + updown)
    aside, across = aside[some], aside[some] < sideways
    step = np.where(lean[some] < 0.5, -1, 1)
    row = np.clip(ring[some] + np.where(across, 0, step), 0, lidar.rings - 1)
    col = (column[some] + np.where(across, step, 0)) % len(firings.azimuth_rad)
    other = hits.rho_m[row, col] * stretch[row]
    spacing = np.where(
        across, 2 * np.pi / len(firings.azimuth_rad), np.abs(firings.slope[row] - firings.slope[ring[some]])
    )
    apart = np.abs(other - slant[some])
    edge = apart > EDGE_M + 1.5 * slant[some] * spacing / np.maximum(echoes.cosine[some], 0.02)
    some, row, col, other, apart = some[edge], row[edge], col[edge], other[edge], apart[edge]
    share = 0.5 * (1.0 - np.where(across, aside / sideways, (aside - sideways) / updown))[edge]  # of the neighbor's

    own_power = echoes.reflectance[some] * (1.0 - share) / slant[some] ** 2
    takes_over = hits.reflectance[row, col] * share / other**2 > own_power
    between = (apart < PULSE_M) | ((fate[some] > 1.0 - BETWEEN_SHARE) & (apart < BETWEEN_M))
    slant[some[between]] += (share * (other - slant[some]))[between]
    chosen = takes_over & ~between
    at, row, col = some[chosen], row[chosen], col[chosen]
    slant[at], echoes.cosine[at] = other[chosen], hits.cosine[row, col]
    echoes.reflectance[at], echoes.owner[at] = hits.reflectance[row, col], hits.owner[row, col]
    echoes.share[some] = np.where(takes_over, share, 1.0 - share)
    echoes.share[some[fate[some] < lidar.split_lost_share]] = 0.0
    return echoes
