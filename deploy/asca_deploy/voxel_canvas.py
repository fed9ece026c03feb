"""The map seen from above that the voxels of the last level make."""

import numpy as np
from numpy.typing import NDArray

from asca_pillars.tables.convolution import Shape


class VoxelCanvas:
    """The map (1, H, W, C), channels last, C being the voxels of a column one above the other (PV-RCNN, section 3.1).

    Allocated once and kept from scan to scan; only the cells of the scan before are cleared.

    Args:
        shape: of the last level, cells along z, y, x.
        channels: C.
    """

    def __init__(self, shape: Shape, channels: int) -> None:
        height, rows, columns = shape
        self.image: NDArray[np.float32] = np.zeros((1, rows, columns, channels), np.float32)
        self.rows = self.image.reshape(-1, channels)
        """(H * W, C), the same memory."""
        self._voxels = self.image.reshape(-1, channels // height)
        self._occupied = np.empty(0, np.int64)

    def scatter(self, features: NDArray[np.float32], cells: NDArray[np.int64]) -> None:
        """Write the features (N, C / nz) of the active voxels; every other one is zero.

        Args:
            features: of the voxels.
            cells: (N,) their flat indices, z running fastest, each once.
        """
        self._voxels[self._occupied] = 0
        self._voxels[cells] = features
        self._occupied = cells
