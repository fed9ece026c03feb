"""Rigid or mirrored transforms of points and boxes between coordinate frames.

Rotation matrices of quaternions and of roll, pitch and yaw, and points transformed by a matrix.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.boxes import Floats, wrap_angle


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


@dataclass(frozen=True, eq=False)
class FrameChange:
    """Rotation or reflection, and translation: p -> axes p + shift_m. Metres.

    Attributes:
        axes: (3, 3) float64 orthogonal; its rows are the new frame's axes in the old frame.
        shift_m: (3,) float64, added after the rotation.
    """

    axes: NDArray[np.float64]
    shift_m: NDArray[np.float64]

    @classmethod
    def turn(cls, angle_rad: float) -> "FrameChange":
        """Return the counter-clockwise rotation about z by the angle; quarter turns are exact."""
        quarters = round(angle_rad / (np.pi / 2))
        if abs(angle_rad - quarters * np.pi / 2) < 1e-12:
            cos, sin = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)][quarters % 4]
        else:
            cos, sin = np.cos(angle_rad), np.sin(angle_rad)
        return cls(np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]]), np.zeros(3))

    @cached_property
    def inverse(self) -> "FrameChange":
        """Inverse transform."""
        return FrameChange(self.axes.T, -self.axes.T @ self.shift_m)

    @cached_property
    def is_identity(self) -> bool:
        """True if points and boxes are unchanged."""
        return bool(np.array_equal(self.axes, np.eye(3)) and not self.shift_m.any())

    def points(self, points: NDArray[Any]) -> NDArray[np.float32]:
        """Transform points (N, >=3) -> float32, x, y, z in metres first; further columns are not changed.

        In a row with a non-finite number, x, y and z may all become non-finite.
        """
        changed = np.array(points, np.float32, order="C")
        with np.errstate(over="ignore", invalid="ignore"):  # values beyond float32 lie outside every range
            transform_points(changed[:, :3], self.axes, self.shift_m, out=changed[:, :3])
        return changed

    def boxes(self, boxes: NDArray[Any]) -> NDArray[np.float32]:
        """Transform boxes (N, 7), metres and radians: centers move with the points, sizes stay, yaws turn about z.

        Exact where z stays vertical. A box has no tilt: in a tilted frame it is off by the frame's tilt.
        """
        centers = transform_points(boxes[:, :3].astype(np.float64), self.axes, self.shift_m)
        yaw = boxes[:, 6].astype(np.float64)
        arrows = transform_points(np.stack([np.cos(yaw), np.sin(yaw)], axis=1), self.axes[:2, :2])
        turned = wrap_angle(np.arctan2(arrows[:, 1], arrows[:, 0]).astype(np.float32))
        return np.concatenate([centers, boxes[:, 3:6], turned[:, None]], axis=1).astype(np.float32)


def is_rigid(matrix: NDArray[np.float64]) -> bool:
    """Return whether a (4, 4) matrix is a rotation without reflection, and a translation, with last row 0 0 0 1."""
    turn = matrix[:3, :3]
    if not np.isfinite(matrix).all() or np.abs(turn).max() > 2:  # squares of larger numbers may overflow
        return False
    orthogonal = np.allclose(turn @ turn.T, np.eye(3), atol=1e-3)
    return bool(orthogonal and np.linalg.det(turn) > 0 and np.allclose(matrix[3], [0, 0, 0, 1]))
