"""Rotation matrices of quaternions and of roll, pitch and yaw, and points transformed by a matrix."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.arrays import Floats


def rotations_from_quaternions(quaternions: NDArray[Any]) -> Floats:
    """Return rotation matrices (..., 3, 3) of quaternions (..., 4) w, x, y, z; NaN if the norm is 0 or not finite."""
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(np.asarray(quaternions, np.float64), axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(quaternions / np.where((lengths > 0) & (lengths < np.inf), lengths, np.nan), -1, 0)
    return _matrices(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotations_from_roll_pitch_yaw(angles_rad: NDArray[Any]) -> Floats:
    """Return rotation matrices (..., 3, 3) of (..., 3): about x by roll, then y by pitch, then z by yaw."""
    angles = np.moveaxis(np.asarray(angles_rad, np.float64), -1, 0)
    (sr, sp, sy), (cr, cp, cy) = np.sin(angles), np.cos(angles)
    return _matrices(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def transform_points(
    points: NDArray[Any], matrix: NDArray[Any], shift: NDArray[Any] | None = None, *, out: NDArray[Any] | None = None
) -> NDArray[Any]:
    """Transform points (N, K) -> (N, J): matrix p + shift, see `transform_columns`.

    Args:
        points: (N, K), metres, K at least 1.
        matrix: (J, K).
        shift: (J,), metres, added afterwards; None: no shift.
        out: (N, J) array to write and return; may be `points` itself. None: a new array.
    """
    columns = transform_columns(np.ascontiguousarray(points.T), matrix, shift)
    transformed = np.empty(columns.shape[::-1], columns.dtype) if out is None else out
    for place, column in enumerate(columns):  # one assignment of all columns takes several times as long
        transformed[:, place] = column
    return transformed


def transform_columns(columns: NDArray[Any], matrix: NDArray[Any], shift: NDArray[Any] | None = None) -> NDArray[Any]:
    """Transform points as columns (K, N), metres -> (J, N): matrix p + shift, in the columns' floating-point type.

    A matrix product of many points would wake the threads of NumPy's BLAS, which then spin for tens of milliseconds on
    the cores that the network needs.
    """
    transformed = np.empty((len(matrix), columns.shape[1]), columns.dtype)
    for row, factors in zip(transformed, matrix.astype(columns.dtype), strict=True):
        np.multiply(factors[0], columns[0], out=row)
        for factor, column in zip(factors[1:], columns[1:], strict=True):
            row += factor * column
    if shift is not None:
        transformed += shift.astype(columns.dtype)[:, None]
    return transformed


def _matrices(rows: list[list[Floats]]) -> Floats:
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))
