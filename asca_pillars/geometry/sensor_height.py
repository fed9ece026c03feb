"""How high the sensor stands, read off a scan: what a detector is most easily wrong about without any error."""

import numpy as np
from numpy.typing import NDArray

RING_M = (4.0, 20.0)  # beyond the vehicle's own roof, before the beams become sparse
PERCENTILE = 10.0  # below it lie ditches and reflections
MIN_POINTS = 50

TOLERANCE_M = 0.5
"""A ground further than this from where a detector expects it is another sensor height, not another road."""


def ground_z_m(points: NDArray[np.float32]) -> float | None:
    """Height of the ground around the sensor, metres: a low percentile of z in a near ring of the points.

    Takes finite points (N, >=3) in the LiDAR frame; None if the ring holds too few of them to tell.
    """
    x, y = points[:, 0], points[:, 1]
    with np.errstate(over="ignore"):  # infinitely far is not near
        squared_range = x * x + y * y
    ring = np.flatnonzero((squared_range > RING_M[0] ** 2) & (squared_range < RING_M[1] ** 2))
    near_z = points[:, 2].take(ring)
    return float(np.percentile(near_z, PERCENTILE)) if len(near_z) >= MIN_POINTS else None
