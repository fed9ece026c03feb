"""Rotation matrices of quaternions and of roll, pitch and yaw."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

_Doubles = NDArray[np.float64]


def of_quaternions(quaternions: NDArray[Any]) -> _Doubles:
    """(..., 3, 3) of (..., 4) w, x, y, z, of any length; not numbers where that is 0 or not finite."""
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


def of_roll_pitch_yaw(angles_rad: NDArray[Any]) -> _Doubles:
    """(..., 3, 3) of (..., 3): about x by roll, then about y by pitch, then about z by yaw."""
    angles = np.moveaxis(np.asarray(angles_rad, np.float64), -1, 0)
    (sr, sp, sy), (cr, cp, cy) = np.sin(angles), np.cos(angles)
    return _matrices(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _matrices(rows: list[list[_Doubles]]) -> _Doubles:
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))
