"""Boxes as frames of their own: x along the heading, y across it, the origin at the center."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.boxes import wrap_angle


def to_box_frames(points: NDArray[np.floating[Any]], boxes: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Points of each box, LiDAR frame -> the box's own: (R, P, 3), (R, 7) -> (R, P, 3)."""
    return _turned(points - boxes[:, None, :3], -boxes[:, 6])


def from_box_frames(points: NDArray[np.floating[Any]], boxes: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Inverse of `to_box_frames`: (R, P, 3), (R, 7) -> (R, P, 3), metres, LiDAR frame."""
    return _turned(points, boxes[:, 6]) + boxes[:, None, :3]


def boxes_in_frames(boxes: NDArray[np.floating[Any]], frames: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """boxes[k] as seen from the box frames[k]: (R, 7), (R, 7) -> (R, 7), metres, yaw in radians, [-pi, pi)."""
    position = to_box_frames(boxes[:, None, :3], frames)[:, 0]
    return np.concatenate([position, boxes[:, 3:6], wrap_angle(boxes[:, 6:] - frames[:, 6:])], axis=1)


def boxes_from_frames(boxes: NDArray[np.floating[Any]], frames: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Inverse of `boxes_in_frames`: (R, 7), (R, 7) -> (R, 7), metres and radians, yaw in [-pi, pi)."""
    position = from_box_frames(boxes[:, None, :3], frames)[:, 0]
    return np.concatenate([position, boxes[:, 3:6], wrap_angle(boxes[:, 6:] + frames[:, 6:])], axis=1)


def roi_grid_points(boxes: NDArray[np.floating[Any]], size: int) -> NDArray[np.floating[Any]]:
    """Centers of size^3 cells of each box, LiDAR frame: (R, 7) -> (R, size^3, 3); z varies fastest, x slowest.

    What RoI-grid pooling looks around (PV-RCNN, section 3.3).
    """
    share = (np.indices((size, size, size)).reshape(3, -1).T + 0.5) / size - 0.5
    return from_box_frames(share.astype(boxes.dtype)[None] * boxes[:, None, 3:6], boxes)


def _turned(points: NDArray[np.floating[Any]], yaw_rad: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """(R, P, 3) turned about z by (R,)."""
    cos, sin = np.cos(yaw_rad)[:, None], np.sin(yaw_rad)[:, None]
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1)
