"""Point cloud range of a detector."""

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
        """Return the ranges translated by (3,) metres."""
        x, y, z = ((low + by, high + by) for (low, high), by in zip(self, by_m, strict=True))
        return Ranges(x, y, z)

    def behind(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return the mask (N,) of points (N, >=2), metres, LiDAR frame, in directions that the detector does not cover.

        A direction is covered if the range extends there as far as ahead or to its nearer side, whichever is less; its
        beginning does not matter. If the range does not extend ahead and to both sides, none is in the mask.
        """
        reach_m = min(self.x_m[1], -self.y_m[0], self.y_m[1])
        x, y = points[:, 0].astype(np.float64), points[:, 1].astype(np.float64)
        return np.asarray((reach_m > 0) & (x * reach_m < min(self.x_m[0], 0.0) * np.hypot(x, y)))

    def hold_centers(self, boxes: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return the mask (N,) of the boxes (N, 7), metres, LiDAR frame, whose center is inside in bird's-eye view."""
        x, y = boxes[:, 0], boxes[:, 1]
        return np.asarray((x >= self.x_m[0]) & (x < self.x_m[1]) & (y >= self.y_m[0]) & (y < self.y_m[1]))
