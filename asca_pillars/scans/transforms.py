"""How the frames of a vehicle lie to each other: ROS' tf, from its messages or from those of a recording."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.rotations import of_quaternions


class Transforms:
    """The latest transform of each frame into its parent."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, NDArray[np.float64]]] = {}

    def add(self, message: Any) -> None:
        """Take what a `tf2_msgs/TFMessage` says; transforms that are no rotation and shift are left out."""
        for one in message.transforms:
            shift, turn = one.transform.translation, one.transform.rotation
            matrix = np.eye(4)
            matrix[:3, :3] = of_quaternions(np.array([turn.w, turn.x, turn.y, turn.z]))
            matrix[:3, 3] = shift.x, shift.y, shift.z
            if np.isfinite(matrix).all():
                self._parents[_plain(one.child_frame_id)] = _plain(one.header.frame_id), matrix

    def between(self, source: str, target: str) -> NDArray[np.float64] | None:
        """(4, 4) matrix, metres, from one frame to another; None where nothing connects them."""
        from_source, from_target = self._upwards(_plain(source)), self._upwards(_plain(target))
        for frame, matrix in from_source.items():
            if frame in from_target:
                return np.asarray(np.linalg.inv(from_target[frame]) @ matrix)
        return None

    @property
    def frames(self) -> list[str]:
        """The names of all frames, sorted."""
        return sorted({*self._parents, *(parent for parent, _ in self._parents.values())})

    def _upwards(self, frame: str) -> dict[str, NDArray[np.float64]]:
        """The matrix from the frame to itself, its parent, that one's parent and so on."""
        matrix = np.eye(4)
        found = {frame: matrix}
        while frame in self._parents:
            frame, step = self._parents[frame]
            if frame in found:  # round in a circle
                break
            matrix = step @ matrix
            found[frame] = matrix
        return found


def _plain(frame: str) -> str:
    """The name of a frame; ROS 1 wrote some with a slash before them."""
    return str(frame).lstrip("/")
