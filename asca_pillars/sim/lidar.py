"""Spinning LiDAR: direction of each laser at each firing, and its measurement parameters.

Every laser fires at counts of the azimuth encoder, in a repeating pattern of steps, and reports range and reflectance.
Random numbers per scan (calibration errors, thresholds) are drawn here; those per firing, in `returns`.

The scan is taken as if the car did not move: KITTI's scans are corrected for ego motion. Others do move during
a scan, but the laser sweeps over one in some milliseconds, in which it moves less than its label box is loose.

The default is the Velodyne HDL-64E of KITTI, with tables fitted to its scans that a data sheet does not give.
"""

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.strict import Strict

# fmt: off
# Fitted to points: laser k reaches z = origin_z[k] + rho tan(elevation[k]) at horizontal distance rho.
ELEVATION_DEG = (
    1.937, 1.574, 1.305, 0.872, 0.579, 0.181, -0.089, -0.452, -0.803, -1.201, -1.494, -1.833, -2.208, -2.547, -2.874,
    -3.236, -3.539, -3.936, -4.216, -4.588, -4.914, -5.251, -5.611, -5.958, -6.329, -6.676, -6.999, -7.287, -7.679,
    -8.058, -8.310, -8.711, -9.026, -9.574, -10.063, -10.471, -10.957, -11.599, -12.115, -12.562, -13.041, -13.485,
    -14.048, -14.598, -15.189, -15.657, -16.177, -16.554, -17.187, -17.730, -18.323, -18.797, -19.320, -19.737,
    -20.222, -20.788, -21.318, -21.936, -22.438, -22.857, -23.323, -23.971, -24.507, -24.999,
)
# Origin heights of the first and last laser of the upper and of the lower block, metres.
ORIGIN_Z_M = ((0.2091, 0.1978), (0.1258, 0.1163))
# Reflectance reported by each laser for the same surface, relative to a typical laser: constant over recording days.
RING_GAIN = (
    1.22, 1.05, 0.96, 0.90, 1.15, 0.96, 1.22, 1.02, 1.19, 0.93, 1.05, 1.12, 1.22, 1.12, 1.00, 1.02, 1.06, 1.09,
    1.06, 0.92, 1.06, 0.69, 1.06, 1.12, 0.91, 1.03, 1.10, 1.12, 1.09, 0.82, 1.10, 1.08, 0.93, 0.93, 1.01, 0.64,
    0.45, 1.04, 1.23, 1.20, 0.93, 1.04, 0.56, 1.04, 1.04, 1.09, 1.09, 0.97, 0.86, 1.12, 1.23, 0.43, 1.01, 0.78,
    0.75, 1.01, 1.09, 1.23, 0.75, 0.75, 0.78, 1.12, 1.27, 1.20,
)
# Rings [first, beyond) occluded by the own car, per 3 degrees of azimuth from straight ahead, counter-clockwise.
EGO_FIRST_RING = (
    57, 57, 57, 58, 58, 60, 62, 64, 64, 61, 62, 61, 62, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64,
    64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 57, 56, 56, 60, 61, 62, 63, 63, 61, 59, 53, 42,
    42, 53, 53, 52, 52, 52, 52, 52, 52, 52, 53, 49, 42, 54, 58, 60, 64, 64, 63, 63, 62, 57, 57, 56, 56, 64, 64,
    64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 51, 49, 49, 47, 47, 47, 48, 48, 48, 54, 64, 64, 64, 64, 64, 61,
    60, 61, 62, 60, 64, 63, 61, 59, 58, 57, 57, 57,
)
EGO_BEYOND_RING = (
    64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 63, 64, 63, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64,
    64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 63, 64, 64, 64, 64, 64, 64,
    64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 63, 64, 64, 64, 61, 64, 64,
    64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 54, 64, 62, 63, 63, 61, 61, 59, 59, 55, 64, 64, 64, 64, 64, 64,
    64, 64, 63, 61, 64, 64, 64, 64, 64, 64, 64, 64,
)
# fmt: on


MAX_COLUMNS = 4096  # the ray caster identifies firings by ring * 4096 + column


@dataclass(frozen=True)
class Lidar(Strict):
    """Spinning LiDAR; the defaults are KITTI's HDL-64E. Angles in degrees, lengths in metres.

    Attributes:
        elevation_deg: elevation of each laser, from the top downwards.
        origin_z_m: origin heights of the lasers in the LiDAR frame: first and last laser of each block of
            equally many lasers from the top, evenly spaced between. Stacked sensors are one list of
            lasers whose blocks have one laser each (configs/simulation/vlp_32c_pair.yaml).
        azimuth_counts: encoder counts of one revolution.
        azimuth_steps: counts from each firing to the next, repeated.
        ego_first_ring, ego_beyond_ring: rings [first, beyond) occluded by the own car, per equal sector of azimuth from
            straight ahead, counter-clockwise; empty for none.
        range_m: nearest and farthest reported range.
    """

    elevation_deg: tuple[float, ...] = ELEVATION_DEG
    origin_z_m: tuple[tuple[float, float], ...] = ORIGIN_Z_M
    azimuth_counts: int = 4000
    azimuth_steps: tuple[int, ...] = (2, 2, 2, 2, 2, 2, 1)
    ego_first_ring: tuple[int, ...] = EGO_FIRST_RING
    ego_beyond_ring: tuple[int, ...] = EGO_BEYOND_RING
    elevation_jitter_deg: float = 0.03  # known to the sensor: a scan of other angles, not an error
    range_m: tuple[float, float] = (2.0, 80.0)
    range_sigma_m: tuple[float, float] = (0.005, 0.010)  # drawn once per scan
    ring_bias_sigma_m: float = 0.022  # with it, points of several rings on a plane spread over 2 to 3 cm
    # A footprint that straddles an edge hits two surfaces: the fraction of firings that straddle to either side, and
    # the fraction of those without a return. KITTI lacks one firing at every fifth step in depth.
    beam_split_share: float = 0.3
    split_lost_share: float = 0.35
    loss_share: tuple[float, float] = (0.0, 0.003)  # returns lost at random, drawn once per scan
    # A return is kept without a reflectance below the first power, and lost below the second. Power is
    # reflectance * sqrt(cos(incidence)) / range^2; both thresholds are drawn together, once per scan.
    zero_power: tuple[float, float] = (2.5e-5, 7.5e-5)
    lost_share_of_zero_power: float = 0.2
    # The true reflectance is reported through a power law about 0.4 (1: linear) that starts at `dark_offset` below
    # 0, times the gain of each laser (empty: 1). Beyond `focus_m` it fades with exp(-((range - focus) / fade)^1.3)
    # (0: not), and the lasers of the first block lose `near_fade` of it at zero range.
    response: float = 0.6
    dark_offset: float = 0.03
    ring_gain: tuple[float, ...] = RING_GAIN
    ring_gain_sigma: float = 0.06  # of the logarithm, once per scan: the lasers of two sensors differ
    focus_m: float = 13.0
    fade_m: float = 33.0
    near_fade: float = 0.4
    # Noise of each report, of the first block and of the others; relative; and of a laser without gain.
    reflectance_sigma: tuple[float, float] = (0.04, 0.02)
    reflectance_sigma_share: float = 0.1
    weak_laser_sigma: float = 0.12
    # Reflectances below a uniform random number up to this are also reported as 0, of the first block and the others.
    faint_reflectance: tuple[float, float] = (0.2, 0.13)
    zero_share: float = 0.03  # of all returns, reported as 0 at random, as of the best lasers on near, bright road
    camera_half_angle_deg: float = 43.0

    def __post_init__(self) -> None:
        if list(self.elevation_deg) != sorted(self.elevation_deg, reverse=True) or not self.elevation_deg:
            raise ConfigError(
                f"elevation_deg is {list(self.elevation_deg)[:4]}, ...: must list the lasers from the top downwards"
            )
        if not self.origin_z_m or self.rings % len(self.origin_z_m):
            raise ConfigError(f"origin_z_m has {len(self.origin_z_m)} blocks, which do not share {self.rings} lasers")
        if min(self.azimuth_steps, default=0) < 1 or self.azimuth_counts < 8 * len(self.azimuth_steps):
            raise ConfigError(
                f"azimuth_steps is {list(self.azimuth_steps)[:4]}, ... of azimuth_counts {self.azimuth_counts}: must "
                "be counts of 1 and more, at most an eighth as many as azimuth_counts"
            )
        if self.azimuth_counts >= MAX_COLUMNS * self.mean_step:
            raise ConfigError(f"azimuth_steps make {MAX_COLUMNS} firings per revolution or more; make them longer")
        if self.ring_gain and len(self.ring_gain) != self.rings:
            raise ConfigError(f"ring_gain has {len(self.ring_gain)} values for {self.rings} lasers")
        if len(self.ego_first_ring) != len(self.ego_beyond_ring):
            raise ConfigError(
                f"ego_first_ring has {len(self.ego_first_ring)} values, ego_beyond_ring {len(self.ego_beyond_ring)}: "
                "must have one for each sector"
            )
        for name in ("range_m", "range_sigma_m", "loss_share", "zero_power"):
            low, high = getattr(self, name)
            if not 0 <= low <= high:
                raise ConfigError(f"{name} is {low, high}: the lower bound comes first, and is not negative")
        if self.zero_power[0] == 0:  # its logarithm is drawn
            raise ConfigError(f"zero_power is {self.zero_power}: must be positive")
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, int | float) and value < 0:
                raise ConfigError(f"{item.name} is {value}: must not be negative")

    @property
    def rings(self) -> int:
        """Number of lasers."""
        return len(self.elevation_deg)

    @property
    def mean_step(self) -> float:
        """Mean number of encoder counts between firings."""
        return sum(self.azimuth_steps) / len(self.azimuth_steps)


@dataclass(frozen=True)
class Firings:
    """Firings of one revolution, or of its part in the camera's view, and the state of the sensor in this scan.

    Firing (k, c) points at `azimuth_rad[c] + phase_rad[k]` with slope `slope[k]`. Its random numbers depend on its ring
    and on the number of its column in the whole revolution.
    """

    slope: npt.NDArray[np.float64]  # (K,) tan(elevation)
    origin_z_m: npt.NDArray[np.float64]  # (K,)
    phase_rad: npt.NDArray[np.float64]  # (K,)
    ring_bias_m: npt.NDArray[np.float64]  # (K,)
    ring_gain: npt.NDArray[np.float64]  # (K,)
    reflectance_sigma: npt.NDArray[np.float64]  # (K,)
    faint: npt.NDArray[np.float64]  # (K,)
    near_fade: npt.NDArray[np.float64]  # (K,)
    azimuth_rad: npt.NDArray[np.float64]  # (C,) of each column, without the phase
    number: npt.NDArray[np.int64]  # (C,) of each column among those of the whole revolution
    columns_per_turn: int
    first_column: npt.NDArray[np.int64]  # (counts + 1,) first column at or after an encoder count
    counted: npt.NDArray[np.bool_]  # (C,) columns whose firings determine the visible fraction of an object
    hidden: npt.NDArray[np.bool_]  # (K,C) firings that the ego vehicle blocks
    outside: npt.NDArray[np.bool_]  # (K,C) firings whose returns are not needed
    range_sigma_m: float
    loss_share: float
    zero_power: float
    lidar: Lidar

    @property
    def lost_power(self) -> float:
        """Received power below which a firing has no return in this scan."""
        return self.zero_power * self.lidar.lost_share_of_zero_power


def draw_firings(lidar: Lidar, rng: np.random.Generator, camera_only: bool, count_all_around: bool = False) -> Firings:
    """Draw the firings of one scan.

    Args:
        lidar: the sensor.
        rng: generator of the scan; each call draws the same number of values from it.
        camera_only: skip the columns outside the camera's view, without changing any random number.
        count_all_around: compute the visible fraction of objects from all columns, not from the camera's alone.
    """
    rings, per_block = lidar.rings, lidar.rings // len(lidar.origin_z_m)
    origin_z = np.concatenate([np.linspace(*block, per_block) for block in lidar.origin_z_m])
    elevation = np.asarray(lidar.elevation_deg) + rng.normal(0.0, lidar.elevation_jitter_deg, rings)
    from_the_top = np.argsort(-elevation, kind="stable")  # the ray caster's windows of rings need descending slopes
    elevation, origin_z = elevation[from_the_top], origin_z[from_the_top]
    steps = np.roll(lidar.azimuth_steps, int(rng.integers(len(lidar.azimuth_steps))))
    columns = np.concatenate([[0], np.cumsum(np.resize(steps, lidar.azimuth_counts))])
    columns = columns[columns < lidar.azimuth_counts]
    count_rad = 2 * np.pi / lidar.azimuth_counts
    azimuth = columns * count_rad
    in_camera = np.minimum(azimuth, 2 * np.pi - azimuth) <= np.deg2rad(lidar.camera_half_angle_deg)
    number = np.flatnonzero(in_camera) if camera_only else np.arange(len(columns))
    azimuth, in_camera = azimuth[number], in_camera[number]
    first_block = np.arange(rings) < per_block
    gain = np.asarray(lidar.ring_gain or np.ones(rings))
    weak = np.maximum(1.0 - gain, 0.0)
    return Firings(
        slope=np.tan(np.deg2rad(elevation)),
        origin_z_m=origin_z,
        phase_rad=rng.uniform(0.0, lidar.mean_step * count_rad, rings),
        ring_bias_m=rng.normal(0.0, lidar.ring_bias_sigma_m, rings),
        ring_gain=gain * np.exp(rng.normal(0.0, lidar.ring_gain_sigma, rings)),
        reflectance_sigma=np.where(first_block, *lidar.reflectance_sigma) + weak * lidar.weak_laser_sigma,
        faint=np.where(first_block, *lidar.faint_reflectance),
        near_fade=np.where(first_block, lidar.near_fade, 0.0),
        azimuth_rad=azimuth,
        number=number,
        columns_per_turn=len(columns),
        first_column=np.searchsorted(columns[number], np.arange(lidar.azimuth_counts + 1)),
        counted=np.ones(len(number), bool) if count_all_around else in_camera,
        hidden=_hidden(lidar, azimuth),
        outside=np.zeros((rings, len(number)), bool),
        range_sigma_m=float(rng.uniform(*lidar.range_sigma_m)),
        loss_share=float(rng.uniform(*lidar.loss_share)),
        zero_power=float(np.exp(rng.uniform(*np.log(lidar.zero_power)))),
        lidar=lidar,
    )


def _hidden(lidar: Lidar, azimuth_rad: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Return (K,C) firings that the ego vehicle blocks."""
    if not lidar.ego_first_ring:
        return np.zeros((lidar.rings, len(azimuth_rad)), bool)
    sector = (azimuth_rad / (2 * np.pi) * len(lidar.ego_first_ring)).astype(int)
    ring = np.arange(lidar.rings)[:, None]
    first, beyond = np.asarray(lidar.ego_first_ring)[sector], np.asarray(lidar.ego_beyond_ring)[sector]
    return np.asarray((ring >= first) & (ring < beyond))
