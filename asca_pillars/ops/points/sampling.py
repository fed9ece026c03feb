"""Points sorted into columns, farthest-point sampling, and bilinear interpolation of maps."""

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
    """Return points (N, >=3), x, y, z in metres first, as contiguous float32, without a copy if possible.

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
    """Sort points (N, >=3) into columns about `column_m` wide; N may be 0."""
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
    """Return row and column of positions: (N, 3) in metres -> (N, 2); outside below 0 or beyond `columns.shape`."""
    along_x, along_y = (
        np.clip((xyz[:, axis] - low) * columns.per_m, np.float32(-1e6), np.float32(1e6))
        for axis, low in enumerate(columns.origin_m)
    )
    return np.floor(np.stack([along_y, along_x], axis=1)).astype(np.int64)


_COLUMN_M = 1.5  # 1 to 3 m take about as long


def farthest_points(points: NDArray[Any], count: int) -> NDArray[np.int32]:
    """Return indices of points by farthest-point sampling, in the order in which they are taken.

    Sampling starts with the first point, then repeatedly takes the one farthest from its nearest sample, by squared
    distance in float32; of equally far ones the earlier. Points are sorted into columns, of which only those that a new
    sample can change are visited.

    Args:
        points: (N, >=3) finite x, y, z in metres; N may be 0.
        count: how many; fewer come out where there are fewer different positions.

    Raises:
        ValueError: another shape, or a coordinate that is not finite.
    """
    xyz = require_points(points)
    if not len(xyz) or count < 1:
        return np.empty(0, np.int32)
    return np.asarray(load_kernels(KERNELS).farthest_points(xyz, count, sort_into_columns(xyz, _COLUMN_M)))


def points_near_boxes(
    points: NDArray[np.float32], boxes: NDArray[np.floating[Any]], margin_m: float
) -> NDArray[np.float32]:
    """Return the points within `margin_m` of the circles around boxes seen from above: (N, 4), (R, 7) -> (M, 4).

    Proposal-centric sampling of keypoints (PV-RCNN++, arXiv 2102.00463, section 4.1).
    """
    points = np.ascontiguousarray(points, np.float32)
    centers = boxes[:, :2].astype(np.float32)
    reach = (np.hypot(boxes[:, 3], boxes[:, 4]) / 2 + margin_m).astype(np.float32)
    return np.asarray(load_kernels(KERNELS).near_circles(points, centers, reach * reach))


def bilinear_cells(
    points: NDArray[np.floating[Any]], x_m: NDArray[np.floating[Any]], y_m: NDArray[np.floating[Any]]
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return flat indices row * W + column of the cells around positions, and weights: (K, >= 2) -> 2 x (K, 4).

    Weights are not negative and sum to 1; outside the map, positions are clamped to its border.

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
    """Interpolate a map's features at K positions, (K, C), from its cells (H * W, C) and `bilinear_cells`, (K, 4).

    Cells are float32, or uint8 steps, of which the result is in steps too.
    """
    read = load_kernels(KERNELS).read_map
    return np.asarray(read(np.ascontiguousarray(rows), np.ascontiguousarray(cells), np.ascontiguousarray(weights)))


def _between(
    values: NDArray[np.floating[Any]], centers: NDArray[np.floating[Any]]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the index of the cell before each value, and the fraction of the way to the next, 0 to 1."""
    centers = centers.astype(np.float64)
    before = np.clip(np.searchsorted(centers, values, side="right") - 1, 0, len(centers) - 2)
    share = (values - centers[before]) / (centers[before + 1] - centers[before])
    return before, np.clip(share, 0.0, 1.0)
