"""Sizes of label boxes by KITTI's statistics."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class SizeStatistics:
    """Label sizes in metres, each (length, width, height), and their correlations.

    Correlations are length-width, length-height, width-height.
    """

    mean: tuple[float, float, float]
    deviation: tuple[float, float, float]
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    correlation: tuple[float, float, float]

    @cached_property
    def spread(self) -> Floats:
        """(3,3) turning independent normal numbers into deviations, metres."""
        lw, lh, wh = self.correlation
        factor = np.linalg.cholesky(np.array([[1.0, lw, lh], [lw, 1.0, wh], [lh, wh, 1.0]]))
        return np.asarray(np.array(self.deviation)[:, None] * factor)


# Of all of KITTI's training labels; the bounds are the 1st and 99th percentile, narrowed where a body needs it.
SIZES = {
    "Car": SizeStatistics(
        (3.884, 1.629, 1.526), (0.426, 0.102, 0.137), (2.94, 1.36, 1.27), (4.89, 1.88, 1.97), (0.35, 0.17, 0.31)
    ),
    "Van": SizeStatistics(
        (5.078, 1.902, 2.207), (0.831, 0.173, 0.325), (3.72, 1.56, 1.71), (6.86, 2.46, 2.87), (0.65, 0.82, 0.67)
    ),
    "Truck": SizeStatistics(
        (10.11, 2.585, 3.252), (2.86, 0.217, 0.449), (5.42, 2.06, 2.32), (16.8, 2.97, 4.19), (0.41, 0.21, 0.38)
    ),
    "Tram": SizeStatistics(
        (16.1, 2.544, 3.529), (7.85, 0.215, 0.176), (9.0, 2.17, 3.17), (35.2, 2.81, 3.84), (0.02, -0.21, 0.10)
    ),
    "Misc": SizeStatistics(
        (3.58, 1.51, 1.91), (2.86, 0.67, 0.81), (1.3, 0.6, 0.9), (11.7, 2.68, 3.6), (0.74, 0.74, 0.65)
    ),
    "Pedestrian": SizeStatistics(
        (0.842, 0.660, 1.761), (0.235, 0.143, 0.113), (0.35, 0.38, 1.10), (1.32, 0.96, 1.97), (0.20, 0.27, 0.13)
    ),
    "Cyclist": SizeStatistics(
        (1.764, 0.597, 1.737), (0.177, 0.124, 0.095), (1.30, 0.36, 1.44), (2.12, 0.88, 1.97), (0.32, 0.37, 0.13)
    ),
    "Person_sitting": SizeStatistics(
        (0.802, 0.595, 1.275), (0.222, 0.079, 0.110), (0.52, 0.48, 1.06), (1.33, 0.75, 1.64), (-0.33, 0.18, 0.33)
    ),
}
CHILD_SHARE = 0.07
MICROCAR_SHARE = 0.02  # two-seaters, which the other cars' spread does not reach
MOTORCYCLE_SHARE = 0.2  # of Misc, whose smallest quarter is two-wheelers


def draw_size(rng: np.random.Generator, name: str) -> Floats:
    """(3,) length, width, height of a label box, metres."""
    if name == "Misc" and rng.random() < MOTORCYCLE_SHARE:
        return rng.uniform((1.7, 0.60, 1.45), (2.3, 0.90, 1.85))
    if name == "Car" and rng.random() < MICROCAR_SHARE:
        return rng.uniform((2.30, 1.45, 1.45), (2.95, 1.62, 1.60))
    statistics = SIZES[name]
    size = np.array(statistics.mean) + statistics.spread @ rng.standard_normal(3)
    size = np.clip(size, statistics.low, statistics.high)
    if name == "Pedestrian" and rng.random() < CHILD_SHARE:
        size *= rng.uniform(0.62, 0.85)
    return np.asarray(size)
