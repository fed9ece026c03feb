"""Points reported by the sensor from the hits of its firings: power, edges, noise, loss, rounding.

The kernels are compiled by numba; see `casting.rays` on changes of other files.
"""

from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.compiling import cached
from asca_pillars.geometry.boxes import Floats, Ints, Mask, Singles
from asca_pillars.sim.casting.raycast import Hits
from asca_pillars.sim.casting.rays import PLAIN, ray_bits
from asca_pillars.sim.lidar import Firings

FADING = 0.5  # spread of the power between firings, in logarithm
PIVOT = 0.4  # the reflectance that the response does not change
UPDOWN_SPLIT = 0.3  # rings are farther apart than firings: a footprint straddles fewer of their edges
EDGE_M = 0.3  # smaller steps are a slant, not an edge
PULSE_M = 0.6  # nearer surfaces give one return
BETWEEN_SHARE, BETWEEN_M = 0.1, 5.0  # how often two echoes farther apart than that still do, and up to which distance

_LEVELS = 4096
_NORMAL = np.array([NormalDist().inv_cdf((i + 0.5) / _LEVELS) for i in range(_LEVELS)])
_FADED = np.exp(FADING * _NORMAL)
_NOISE_SALT, _FATE_SALT = 1, 2


class FirstHits(NamedTuple):
    """First hits of the firings (K,C), as in `Hits`; rho is infinite without a hit."""

    rho_m: Floats
    cosine: Singles
    reflectance: Singles
    owner: NDArray[np.int32]
    hidden: Mask  # firings without a report: blocked by the ego vehicle, or not needed


class Lasers(NamedTuple):
    """Lasers (K,) and columns (C,) of a scan, as in `Firings`."""

    slope: Floats
    stretch: Floats  # length of a ray per metre of horizontal distance
    origin_z_m: Floats
    cos_phase: Floats
    sin_phase: Floats
    range_bias_m: Floats
    gain: Floats
    reflectance_sigma: Floats
    faint: Floats
    near_fade: Floats
    cos_azimuth: Floats
    sin_azimuth: Floats
    number: Ints


class Receiver(NamedTuple):
    """Parameters of all lasers: those of `Lidar`, and those drawn for the scan in `Firings`."""

    lost_power: float
    zero_power: float
    loss_share: float
    zero_share: float
    near_m: float
    far_m: float
    range_sigma_m: float
    response: float
    dark_offset: float
    focus_m: float
    fade_m: float
    sigma_share: float
    split_share: float
    split_lost_share: float
    columns_per_turn: int


class Echo(NamedTuple):
    """Echo of a firing, before noise, from the surface that firing (ring, column) met."""

    slant_m: float
    cosine: float
    reflectance: float
    share: float  # of the beam's power that hit it; 0 for a lost echo
    ring: int
    column: int


@cached(inline="always", **PLAIN)
def echo_of(
    k: int,
    j: int,
    lean: float,
    fate: float,
    rho: Floats,
    cosine: Singles,
    reflectance: Singles,
    stretch: Floats,
    slopes: Floats,
    number: Ints,
    receiver: Receiver,
) -> Echo:
    """Return the echo of firing (k, j), which may straddle an edge to a neighboring firing's surface.

    rho in metres, cosine and reflectance are (K, C), as in `FirstHits`; stretch, slopes (K,) and number (C,) as in
    `Lasers`. `lean` in 0..1 selects the neighbor and the part on it, `fate` in 0..1 the result of two echoes: none, one
    between both, or the stronger of them.
    """
    columns, turn = rho.shape[1], receiver.columns_per_turn
    slant = rho[k, j] * stretch[k]
    sideways, updown = receiver.split_share, receiver.split_share * UPDOWN_SPLIT
    aside, step = min(lean, 1.0 - lean), -1 if lean < 0.5 else 1
    across = aside < sideways
    row = k if across else min(max(k + step, 0), len(slopes) - 1)
    column = (j + step + columns) % columns if across else j
    other = rho[row, column] * stretch[row]
    if across and number[column] != (number[j] + step + turn) % turn:
        other = np.inf  # at the ends of the cast part of the revolution
    apart = abs(other - slant)
    spacing = 2 * np.pi / turn if across else abs(slopes[row] - slopes[k])
    hit = Echo(slant, cosine[k, j], reflectance[k, j], 1.0, k, j)
    if aside >= sideways + updown or not apart > EDGE_M + 1.5 * slant * spacing / max(hit.cosine, 0.02):
        return hit
    if fate < receiver.split_lost_share:
        return Echo(slant, hit.cosine, hit.reflectance, 0.0, k, j)
    share = 0.5 * (1.0 - (aside / sideways if across else (aside - sideways) / updown))  # of the neighbor's
    takes_over = reflectance[row, column] * share / other**2 > hit.reflectance * (1.0 - share) / slant**2
    met = share if takes_over else 1.0 - share
    if apart < PULSE_M or (fate > 1.0 - BETWEEN_SHARE and apart < BETWEEN_M):
        return Echo(slant + share * (other - slant), hit.cosine, hit.reflectance, met, k, j)
    if takes_over:
        return Echo(other, cosine[row, column], reflectance[row, column], met, row, column)
    return Echo(slant, hit.cosine, hit.reflectance, met, k, j)


@cached(inline="always", **PLAIN)
def fade_of(slant: float, near_fade: float, receiver: Receiver) -> float:
    """Return the ratio of reported to true reflectance: largest where the lens is focused."""
    if receiver.fade_m <= 0.0:
        return 1.0
    if slant > receiver.focus_m:
        return np.exp(-(((slant - receiver.focus_m) / receiver.fade_m) ** 1.3))
    return 1.0 - near_fade * (1.0 - slant / receiver.focus_m) ** 1.5


@cached(**PLAIN)
def report_firings(
    met: FirstHits, lasers: Lasers, receiver: Receiver, key: int
) -> tuple[Singles, NDArray[np.int32], Ints]:
    """Return points (N, 4) in the LiDAR frame, indices of their owners (N,) and rings (N,), ring by ring."""
    rho, cosine, reflectance, owners, hidden = met.rho_m, met.cosine, met.reflectance, met.owner, met.hidden
    slopes, stretch, origins, cos_phase, sin_phase, biases, gains, sigmas, faints, near_fades = lasers[:10]
    cosines, sines, number = lasers[10:]
    rings, columns = rho.shape
    most = np.isfinite(rho).sum()
    points, owner = np.empty((most, 4), np.float32), np.empty(most, np.int32)
    ring = np.empty(most, np.int64)
    kept = 0
    for k in range(rings):
        for j in range(columns):
            if not rho[k, j] < np.inf or hidden[k, j]:
                continue
            bits, more = ray_bits(key, k, number[j], _NOISE_SALT), ray_bits(key, k, number[j], _FATE_SALT)
            luck, faint = _uniform(bits, 3), _uniform(more, 0)
            echo = echo_of(
                k, j, _uniform(more, 1), _uniform(more, 2), rho, cosine, reflectance, stretch, slopes, number, receiver
            )
            # Rough surfaces return light at grazing incidence, too: the root of the cosine, not the cosine.
            power = echo.reflectance * np.sqrt(echo.cosine) / echo.slant_m**2 * echo.share * _FADED[_level(bits, 1)]
            slant = echo.slant_m + _NORMAL[_level(bits, 0)] * receiver.range_sigma_m + biases[k]
            if not (power > receiver.lost_power and luck >= receiver.loss_share):
                continue
            if not receiver.near_m < slant < receiver.far_m:
                continue
            value = (PIVOT + receiver.dark_offset) * (echo.reflectance / PIVOT) ** receiver.response
            value = (value - receiver.dark_offset) * gains[k] * fade_of(echo.slant_m, near_fades[k], receiver)
            value += (sigmas[k] + receiver.sigma_share * value) * _NORMAL[_level(bits, 2)]
            if power < receiver.zero_power or value < faints[k] * faint or luck > 1.0 - receiver.zero_share:
                value = 0.0
            flat = slant / stretch[k]
            x = flat * (cosines[j] * cos_phase[k] - sines[j] * sin_phase[k])
            y = flat * (sines[j] * cos_phase[k] + cosines[j] * sin_phase[k])
            points[kept, 0], points[kept, 1] = np.round(x * 1000.0) / 1000.0, np.round(y * 1000.0) / 1000.0
            points[kept, 2] = np.round((origins[k] + flat * slopes[k]) * 1000.0) / 1000.0
            points[kept, 3] = np.floor(min(max(value, 0.0), 0.995) * 100.0) / 100.0
            owner[kept], ring[kept] = owners[echo.ring, echo.column], k
            kept += 1
    return points[:kept], owner[:kept], ring[:kept]


@cached(inline="always", **PLAIN)
def _level(bits: np.uint64, part: int) -> int:
    """Return one of _LEVELS, from the quarter `part` of 64 random bits."""
    return int((bits >> np.uint64(16 * part)) & np.uint64(_LEVELS - 1))


@cached(inline="always", **PLAIN)
def _uniform(bits: np.uint64, part: int) -> float:
    """Return a number in [0, 1), from the quarter `part` of 64 random bits: 16 are fine enough."""
    return float((bits >> np.uint64(16 * part)) & np.uint64(65535)) / 65536.0


class Returns(NamedTuple):
    """Points in the order of KITTI's files: ring by ring from the top, each counter-clockwise from straight ahead."""

    points: Singles  # (N,4) x, y, z metres, reflectance 0..0.99 in steps of 0.01
    owner: NDArray[np.int32]  # (N,) object index, BACKGROUND or GROUND
    ring: Ints  # (N,)


def measure(hits: Hits, firings: Firings, rng: np.random.Generator) -> Returns:
    """Measure one revolution. A firing's noise depends on its ring and column, not on the other cast ones."""
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
    met = FirstHits(
        rho_m=np.ascontiguousarray(hits.rho_m, np.float64),
        cosine=np.ascontiguousarray(hits.cosine, np.float32),
        reflectance=np.ascontiguousarray(hits.reflectance, np.float32),
        owner=np.ascontiguousarray(hits.owner, np.int32),
        hidden=firings.hidden | firings.outside,
    )
    return Returns(*report_firings(met, lasers, receiver, int(rng.integers(1 << 62))))
