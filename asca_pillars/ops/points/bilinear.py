"""Where positions lie on the first stage's map: four cells and their weights (PV-RCNN, section 3.2, BEV features)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.kernels import load_kernels
from asca_pillars.ops.points.columns import KERNELS


def bilinear_cells(
    points: NDArray[np.floating[Any]], x_m: NDArray[np.floating[Any]], y_m: NDArray[np.floating[Any]]
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Flat indices row * W + column of the cells around each position, and their weights: (K, >= 2) -> 2 x (K, 4).

    Weights are not negative and sum to 1; beside the map its border counts.

    Args:
        points: x, y in metres first.
        x_m, y_m: (W,), (H,) ascending centers of the map's cells, which need not be evenly spaced; at least two each.
    """
    left, along_x = _between(points[:, 0], x_m)
    low, along_y = _between(points[:, 1], y_m)
    cells = [(low + up) * len(x_m) + left + right for up in (0, 1) for right in (0, 1)]
    weights = [a * b for a in (1 - along_y, along_y) for b in (1 - along_x, along_x)]
    return np.stack(cells, axis=1).astype(np.int32), np.stack(weights, axis=1).astype(np.float32)


def read_map(rows: NDArray[Any], cells: NDArray[np.int32], weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """A map's features at K positions, (K, C), from its cells (H * W, C) and what `bilinear_cells` gave, (K, 4).

    Cells are float32, or uint8 steps, of which the result is in steps too.
    """
    read = load_kernels(KERNELS).read_map
    return np.asarray(read(np.ascontiguousarray(rows), np.ascontiguousarray(cells), np.ascontiguousarray(weights)))


def _between(
    values: NDArray[np.floating[Any]], centers: NDArray[np.floating[Any]]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The cell before each value, and how far the value is on the way to the next, 0 to 1."""
    centers = centers.astype(np.float64)
    before = np.clip(np.searchsorted(centers, values, side="right") - 1, 0, len(centers) - 2)
    share = (values - centers[before]) / (centers[before + 1] - centers[before])
    return before, np.clip(share, 0.0, 1.0)
