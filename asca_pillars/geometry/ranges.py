"""The box around the sensor in which a detector looks."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Ranges(NamedTuple):
    """(lowest, highest) along each axis in metres, LiDAR frame; the lowest is inside, the highest is not."""

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    z_m: tuple[float, float]

    def shifted(self, by_m: Sequence[float] | NDArray[np.float64]) -> "Ranges":
        """Where they lie after everything moved by (3,) metres."""
        x, y, z = ((low + by, high + by) for (low, high), by in zip(self, by_m, strict=True))
        return Ranges(x, y, z)

    def hold_centers(self, boxes: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Which boxes (N, 7), metres, LiDAR frame, have their center inside, seen from above: (N,)."""
        x, y = boxes[:, 0], boxes[:, 1]
        return np.asarray((x >= self.x_m[0]) & (x < self.x_m[1]) & (y >= self.y_m[0]) & (y < self.y_m[1]))
