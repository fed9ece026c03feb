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
        """The ranges after everything moved by (3,) metres."""
        x, y, z = ((low + by, high + by) for (low, high), by in zip(self, by_m, strict=True))
        return Ranges(x, y, z)

    def behind(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Mask (N,) of points (N, >=2), metres, LiDAR frame, in directions in which the detector does not look.

        It looks in a direction if it sees as far there as it does ahead or to its nearer side, whichever is less; where
        its range begins is no matter. None of the points, if it does not see ahead and to both sides.
        """
        reach_m = min(self.x_m[1], -self.y_m[0], self.y_m[1])
        x, y = points[:, 0].astype(np.float64), points[:, 1].astype(np.float64)
        return np.asarray((reach_m > 0) & (x * reach_m < min(self.x_m[0], 0.0) * np.hypot(x, y)))

    def hold_centers(self, boxes: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Mask (N,) of the boxes (N, 7), metres, LiDAR frame, whose center is inside, seen from above."""
        x, y = boxes[:, 0], boxes[:, 1]
        return np.asarray((x >= self.x_m[0]) & (x < self.x_m[1]) & (y >= self.y_m[0]) & (y < self.y_m[1]))
