"""Statistics that are compared, and those of KITTI in the package.

Statistics that scans cropped to the camera's view lack are None. Ranges are in metres, reflectances in hundredths.
"""

import json
import math
from dataclasses import dataclass, field
from functools import cache
from importlib import resources

from asca_pillars.base.schema import parse
from asca_pillars.base.strict import Strict

CLASSES = ("Car", "Pedestrian", "Cyclist")
BAND_M = 10.0  # of statistics by range, from 0 to 80 m
BANDS = 8
SECTORS = 72  # of 5 degrees of azimuth, counter-clockwise from straight ahead
RANGE_BINS = 80  # of 1 m, of slant range
LABEL_RANGE_BINS = 20  # of 5 m, of horizontal distance
YAW_BINS = 24  # of 15 degrees from -pi
REFLECTANCES = 100  # 0.00 to 0.99
MAX_PER_FRAME = 20
PERCENTILES = (5, 25, 50, 75, 95)
CAR_FIT_RANGE_M = (12.0, 70.0)
"""Range of KITTI's cars in the fit. A power law holds piecewise only: fits are comparable over the same span only."""
NEAR_CARS_M = (12.0, 50.0)
"""Farther cars have so few returns that one changes the fit considerably, and many have no label."""
TRUNCATION_EDGES = (0.0, 0.15, 0.30, 0.50)  # fractions above the last are the fifth group


@dataclass(frozen=True)
class Spread(Strict):
    """Distribution of a quantity; percentiles are those of PERCENTILES."""

    mean: float
    std: float
    percentiles: tuple[float, ...]


@dataclass(frozen=True)
class Band(Strict):
    """Mean and standard deviation of a quantity, in one band of range or over the scans."""

    mean: float
    std: float


@dataclass(frozen=True)
class Reflectance(Strict):
    """Histogram of reflectance (REFLECTANCES,), and the number of scans or objects of its points."""

    counts: tuple[float, ...]
    units: int


@dataclass(frozen=True)
class CarFit(Strict):
    """Points of an unoccluded, untruncated car at range r: exp(a) r^b, by least squares of the logarithms.

    Attributes:
        a, b: the line.
        cars: number of cars in the fit.
        residual: standard deviation of the logarithms of the points about it.
        log_range: mean and standard deviation of the logarithms of the cars' ranges.
    """

    a: float
    b: float
    cars: int
    residual: float
    log_range: Band

    def points_at(self, range_m: float) -> float:
        """Return the number of returns of such a car at `range_m`."""
        return math.exp(self.a + self.b * math.log(range_m))

    def error_at(self, range_m: float) -> float:
        """Return the relative standard error of `points_at`, from the scatter of the cars and their distance."""
        away = (math.log(range_m) - self.log_range.mean) / self.log_range.std
        return self.residual * math.sqrt((1 + away**2) / self.cars)


@dataclass(frozen=True)
class ScanStatistics(Strict):
    """Statistics of scans; unless stated otherwise, means over the scans.

    Attributes:
        scans: number of measured scans.
        points, camera_points: returns of a scan, and those in the image.
        ground_share, camera_ground_share: fractions of ground among these returns.
        points_per_ring: (rings,) from the top, None also if scans differ in their number.
        sector_points: (SECTORS,) points per 5 degrees of azimuth.
        range_points: (RANGE_BINS,) points per metre of slant range.
        ground_z_m, ground_reflectance: (BANDS,) of slant range, of all ground returns together.
        reflectance: by "overall", "ground", "non_ground" and the classes of objects in small letters. An object's
            points are those in its box more than 0.1 m above its bottom.
        car_fit, near_car_fit: over CAR_FIT_RANGE_M and NEAR_CARS_M; None with too few cars.
    """

    scans: int
    camera_points: Band
    camera_ground_share: Band
    reflectance: dict[str, Reflectance]
    car_fit: CarFit | None
    near_car_fit: CarFit | None
    points: Band | None = None
    ground_share: Band | None = None
    points_per_ring: tuple[float, ...] | None = None
    sector_points: tuple[float, ...] | None = None
    range_points: tuple[float, ...] | None = None
    ground_z_m: tuple[Band | None, ...] | None = None
    ground_reflectance: tuple[Band | None, ...] | None = None


@dataclass(frozen=True)
class LabelStatistics(Strict):
    """Statistics of the labels of one class; boxes in the LiDAR frame.

    Attributes:
        count: number of labelled objects.
        per_frame: (MAX_PER_FRAME + 1,) frames with 0, 1, 2 ... objects; the last includes those with more.
        height_m, width_m, length_m: sizes.
        left_m: the center's lateral position.
        range_counts: (LABEL_RANGE_BINS,) of horizontal distance.
        bottom_z_m: (BANDS,) of horizontal distance.
        yaw_counts: (YAW_BINS,); 0 is the direction of the car.
        yaw_same, yaw_oncoming, yaw_across: fractions within 15 degrees of the car's, of the opposite, and across.
        occlusion: (4,) objects of each state.
        truncation: (5,) objects truncated by nothing, up to 0.15, 0.30, 0.50, and by more.
    """

    count: int
    per_frame: tuple[int, ...]
    height_m: Spread
    width_m: Spread
    length_m: Spread
    left_m: Spread
    range_counts: tuple[int, ...]
    bottom_z_m: tuple[Band | None, ...]
    yaw_counts: tuple[int, ...]
    yaw_same: float
    yaw_oncoming: float
    yaw_across: float
    occlusion: tuple[int, ...]
    truncation: tuple[int, ...]


@dataclass(frozen=True)
class Fit(Strict):
    """Statistic of the fit of labels to points (`object_fits`), over the objects of one drive or folder.

    Attributes:
        source: the drive or folder.
        objects: number of objects with the statistic.
        middle: their median; of a fraction, their mean.
        low, high: 10th and 90th percentile.
    """

    source: str
    objects: int
    middle: float
    low: float
    high: float


@dataclass(frozen=True)
class Statistics(Strict):
    """Statistics of a data set: its scans, the labels of CLASSES that occur, and DontCare areas per frame.

    `label_fit` has the fit of labels to points by "Car flank_end" and the like: for KITTI by drive, because
    the cars of a drive are few and labelled by one annotator.
    """

    source: str
    scan: ScanStatistics
    frames: int
    labels: dict[str, LabelStatistics]
    dont_care_per_frame: float
    label_fit: dict[str, tuple[Fit, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class Sensor(Strict):
    """KITTI's HDL-64E: a point of ring k at horizontal distance rho has z = origin_z_m[k] + rho tan(elevation)."""

    elevation_deg: tuple[float, ...]
    origin_z_m: tuple[float, ...]
    firings_per_ring: float


@dataclass(frozen=True)
class Reference(Strict):
    """KITTI's statistics and sensor, as in the package."""

    statistics: Statistics
    sensor: Sensor


@cache
def kitti_reference() -> Reference:
    """Return the statistics of KITTI's scans in the package."""
    name = "kitti_statistics.json"
    text = resources.files("asca_pillars.sim").joinpath(name).read_text(encoding="utf-8")
    return parse(Reference, json.loads(text), name)
