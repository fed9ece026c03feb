"""Rigid or mirrored transforms of points and boxes between coordinate frames."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.boxes import wrap_angle
from asca_pillars.geometry.rotations import transform_points


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
