"""Bird's-eye-view map of the voxels of the last level."""

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from asca_pillars.ops.sparse.rulebooks import Shape


class VoxelCanvas:
    """The map (1, H, W, C), channels last, C being the voxels of a column one above the other (PV-RCNN, section 3.1).

    Allocated once and kept from scan to scan; only the cells of the scan before are cleared.

    Args:
        shape: of the last level, cells along z, y, x.
        channels: C.
        dtype: of what is scattered: float32, or uint8 for whole steps.
    """

    def __init__(self, shape: Shape, channels: int, dtype: DTypeLike = np.float32) -> None:
        height, rows, columns = shape
        self.image: NDArray[Any] = np.zeros((1, rows, columns, channels), dtype)
        self.rows = self.image.reshape(-1, channels)
        """(H * W, C), the same memory."""
        self._voxels = self.image.reshape(-1, channels // height)
        self._occupied = np.empty(0, np.int64)

    def scatter(self, features: NDArray[Any], cells: NDArray[np.int64]) -> None:
        """Write the features (N, C / nz) of the active voxels; every other one is zero.

        Args:
            features: of the voxels.
            cells: (N,) their flat indices, z running fastest, each once.
        """
        self._voxels[self._occupied] = 0
        self._voxels[cells] = features
        self._occupied = cells
