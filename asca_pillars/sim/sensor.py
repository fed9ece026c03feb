"""The spinning LiDAR: where each laser points at each firing, and what of the world it keeps.

The numbers are those of the Velodyne HDL-64E of KITTI, fitted on scans: laser k of the top 32 and of the bottom 32
leaves the sensor at its own height, so a firing reaches z = origin_z[k] + rho tan(elevation[k]) at horizontal
distance rho. Azimuths are encoder counts of 0.09 degrees; a firing comes every two counts, every seventh after one.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

# fmt: off
HDL64_ELEVATION_DEG = (
    1.937, 1.574, 1.305, 0.872, 0.579, 0.181, -0.089, -0.452, -0.803, -1.201, -1.494, -1.833, -2.208, -2.547, -2.874,
    -3.236, -3.539, -3.936, -4.216, -4.588, -4.914, -5.251, -5.611, -5.958, -6.329, -6.676, -6.999, -7.287, -7.679,
    -8.058, -8.310, -8.711, -9.026, -9.574, -10.063, -10.471, -10.957, -11.599, -12.115, -12.562, -13.041, -13.485,
    -14.048, -14.598, -15.189, -15.657, -16.177, -16.554, -17.187, -17.730, -18.323, -18.797, -19.320, -19.737,
    -20.222, -20.788, -21.318, -21.936, -22.438, -22.857, -23.323, -23.971, -24.507, -24.999,
)
# First ring that the own car hides, per 5 degrees of azimuth from straight ahead, counter-clockwise (64 = none).
HDL64_EGO_RING = (
    57, 57, 58, 60, 64, 62, 64, 63, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64,
    64, 56, 56, 58, 62, 64, 60, 56, 48, 53, 52, 52, 52, 52, 52, 52, 46, 60, 62, 62, 61, 56, 56, 59,
    64, 64, 64, 64, 64, 64, 64, 52, 49, 47, 47, 48, 64, 64, 64, 64, 64, 64, 64, 64, 61, 61, 57, 57,
)
# fmt: on
COUNT_DEG = 0.09
COUNTS = 4000  # encoder counts of one revolution


@dataclass(frozen=True)
class Lidar:
    """A spinning LiDAR; the defaults are KITTI's HDL-64E. Angles in degrees, lengths in metres."""

    elevation_deg: tuple[float, ...] = HDL64_ELEVATION_DEG
    origin_z_upper_m: tuple[float, float] = (0.2091, 0.1978)  # ring 0 .. the last of the upper half
    origin_z_lower_m: tuple[float, float] = (0.1258, 0.1163)
    ego_ring: tuple[int, ...] = HDL64_EGO_RING
    elevation_jitter_deg: float = 0.03
    range_m: tuple[float, float] = (2.0, 80.0)
    range_sigma_m: tuple[float, float] = (0.006, 0.011)  # drawn once per scan
    ring_bias_sigma_m: float = 0.009
    ring_gain_sigma: float = 0.15  # of the logarithm: no two lasers report the same reflectance
    loss_share: tuple[float, float] = (0.0, 0.03)  # returns lost for no reason, drawn once per scan
    # A return is kept without a reflectance below the first power, and lost below the second. Power is
    # reflectance * sqrt(cos(incidence)) / range^2; both thresholds are drawn together, once per scan.
    zero_power: tuple[float, float] = (5e-5, 1.2e-4)
    lost_share_of_zero_power: float = 0.17
    faint_reflectance: float = 0.10  # reflectances below a uniform draw up to this are reported as 0 too
    # Returns at a hundredth of their power: the beam only grazes what it meets.
    weak_share: tuple[float, float] = (0.02, 0.07)
    camera_half_angle_deg: float = 43.0

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012 - a class constant that pydantic reads

    @property
    def rings(self) -> int:
        return len(self.elevation_deg)


@dataclass(frozen=True)
class Firings:
    """Every firing of one revolution, and the random state of the sensor for this scan.

    Firing (k, c) points at azimuth `count[c] * COUNT_DEG + phase[k]` (radians below) with slope `slope[k]`.
    """

    slope: npt.NDArray[np.float64]  # (K,) tan(elevation)
    origin_z_m: npt.NDArray[np.float64]  # (K,)
    phase_rad: npt.NDArray[np.float64]  # (K,)
    ring_bias_m: npt.NDArray[np.float64]  # (K,)
    ring_gain: npt.NDArray[np.float64]  # (K,)
    azimuth_rad: npt.NDArray[np.float64]  # (C,) of each column, without the phase
    first_column: npt.NDArray[np.int64]  # (COUNTS + 1,) first column at or after an encoder count
    cast: npt.NDArray[np.bool_]  # (C,) columns that are fired at all
    in_camera: npt.NDArray[np.bool_]  # (C,) columns that the camera sees
    hidden_from: npt.NDArray[np.int64]  # (C,) first ring that the own car hides
    range_sigma_m: float
    loss_share: float
    weak_share: float
    zero_power: float
    lost_power: float
    faint: float
    range_m: tuple[float, float]


def draw_firings(lidar: Lidar, rng: np.random.Generator, camera_only: bool) -> Firings:
    """The firings of one scan. `camera_only` leaves every random number as it is and only skips columns."""
    half = lidar.rings // 2
    origin_z = np.concatenate(
        [np.linspace(*lidar.origin_z_upper_m, half), np.linspace(*lidar.origin_z_lower_m, lidar.rings - half)]
    )
    elevation = np.asarray(lidar.elevation_deg) + rng.normal(0.0, lidar.elevation_jitter_deg, lidar.rings)
    elevation = np.sort(elevation)[::-1]  # the ring windows of the ray caster need descending slopes
    counts = np.full(COUNTS, 2)
    counts[int(rng.integers(7)) :: 7] = 1
    columns = np.concatenate([[0], np.cumsum(counts)])
    columns = columns[columns < COUNTS]
    azimuth_deg = columns * COUNT_DEG
    from_ahead = np.minimum(azimuth_deg, 360.0 - azimuth_deg)
    in_camera = from_ahead <= lidar.camera_half_angle_deg
    sectors = np.asarray(lidar.ego_ring)
    zero_power = float(np.exp(rng.uniform(*np.log(lidar.zero_power))))
    return Firings(
        slope=np.tan(np.deg2rad(elevation)),
        origin_z_m=origin_z,
        phase_rad=np.deg2rad(rng.uniform(0.0, 2 * COUNT_DEG, lidar.rings)),
        ring_bias_m=rng.normal(0.0, lidar.ring_bias_sigma_m, lidar.rings),
        ring_gain=np.exp(rng.normal(0.0, lidar.ring_gain_sigma, lidar.rings)),
        azimuth_rad=np.deg2rad(azimuth_deg),
        first_column=np.searchsorted(columns, np.arange(COUNTS + 1)),
        cast=in_camera if camera_only else np.ones(len(columns), bool),
        in_camera=in_camera,
        hidden_from=sectors[(azimuth_deg / 360.0 * len(sectors)).astype(int)],
        range_sigma_m=float(rng.uniform(*lidar.range_sigma_m)),
        loss_share=float(rng.uniform(*lidar.loss_share)),
        weak_share=float(rng.uniform(*lidar.weak_share)),
        zero_power=zero_power,
        lost_power=zero_power * lidar.lost_share_of_zero_power,
        faint=lidar.faint_reflectance,
        range_m=lidar.range_m,
    )
