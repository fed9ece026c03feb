"""Points sorted into square columns seen from above: what is near a place is found without looking at the rest."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.kernels import load_kernels

KERNELS = "asca_pillars.ops.points.sampling_kernels"
_MAX_COLUMNS = 1024  # along each axis; beyond it columns grow wider, so that one stray point costs no memory


class Columns(NamedTuple):
    """N points in ny x nx columns."""

    order: NDArray[np.int32]
    """(N,) indices of the points, column after column; within one, as the points are stored."""
    starts: NDArray[np.int32]
    """(ny * nx + 1,) where each column begins in `order`; column (row, column) is row * nx + column."""
    origin_m: tuple[np.float32, np.float32]
    """Smallest x and y of the points."""
    per_m: np.float32
    """Columns per metre."""
    shape: tuple[int, int]
    """ny, nx."""


def require_points(points: NDArray[Any]) -> NDArray[np.float32]:
    """Points (N, >=3), x, y, z in metres first, as contiguous float32; themselves if they are.

    Raises:
        ValueError: another shape, or a coordinate that is not finite, which has no column.
    """
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"points must have shape (N, 3 or more), not {points.shape}")
    rows = np.ascontiguousarray(points, np.float32)
    # Where every value is finite, looking at the coordinates alone would take longer.
    if not np.isfinite(rows).all() and not np.isfinite(rows[:, :3]).all():
        raise ValueError("points must be finite; drop the others first")
    return rows


def sort_into_columns(xyz: NDArray[np.float32], column_m: float) -> Columns:
    """Columns of points (N, >=3), about `column_m` wide; N may be 0."""
    if not len(xyz):
        return Columns(
            np.empty(0, np.int32), np.zeros(2, np.int32), (np.float32(0), np.float32(0)), np.float32(1), (1, 1)
        )
    # One axis at a time: NumPy is slow along an axis as short as the coordinates'.
    low, high = zip(*((values.min(), values.max()) for values in (xyz[:, 0], xyz[:, 1])), strict=True)
    widest = max(float(last) - float(first) for first, last in zip(low, high, strict=True))
    per_m = np.float32(1 / max(column_m, widest / (_MAX_COLUMNS - 1)))
    nx, ny = (int((last - first) * per_m) + 1 for first, last in zip(low, high, strict=True))
    order, starts = load_kernels(KERNELS).sort(xyz, low[0], low[1], per_m, ny, nx)
    return Columns(order, starts, low, per_m, (ny, nx))


def cells_of(xyz: NDArray[np.float32], columns: Columns) -> NDArray[np.int64]:
    """Row and column of positions: (N, 3) in metres -> (N, 2); beside the points below 0 or beyond `columns.shape`."""
    along_x, along_y = (
        np.clip((xyz[:, axis] - low) * columns.per_m, np.float32(-1e6), np.float32(1e6))
        for axis, low in enumerate(columns.origin_m)
    )
    return np.floor(np.stack([along_y, along_x], axis=1)).astype(np.int64)
