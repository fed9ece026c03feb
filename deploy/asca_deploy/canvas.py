"""The scatter between the two graphs: pillar features back to their places in the pseudo-image."""

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.grid import PillarGrid


class Canvas:
    """The pseudo-image (1, C, ny, nx) float32, allocated once and kept from frame to frame.

    A frame fills a few percent of the cells: clearing only the cells of the frame before is many times faster
    than a new image of zeros, 64 MB for the paper's grid.
    """

    def __init__(self, channels: int, grid: PillarGrid) -> None:
        self.image = np.zeros((1, channels, grid.ny, grid.nx), np.float32)
        self._columns = self.image.reshape(channels, grid.ny * grid.nx)
        self._occupied = np.empty(0, np.int64)

    def scatter(self, pillar_features: NDArray[np.float32], cells: NDArray[np.int64]) -> NDArray[np.float32]:
        """Write each pillar's features into its cell; every other cell is zero.

        Args:
            pillar_features: (P, C).
            cells: (P,) flat indices row * nx + column, each at most once.

        Returns:
            The pseudo-image (1, C, ny, nx). It is this object's own memory: valid until the next call.
        """
        self._columns[:, self._occupied] = 0.0
        self._occupied = cells
        self._columns[:, cells] = pillar_features.T
        return self.image
