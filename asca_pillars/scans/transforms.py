"""Transforms between the frames of a vehicle: ROS' tf, from live messages or a recording."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ScanError
from asca_pillars.geometry.frame_change import rotations_from_quaternions
from asca_pillars.scans.recordings.messages import decode_message
from asca_pillars.scans.recordings.recording import Recording, reason

TRANSFORM_TYPES = ("tf2_msgs/msg/TFMessage", "tf2_msgs/TFMessage", "tf/msg/tfMessage", "tf/tfMessage")
_STATIC = "tf_static"


class Transforms:
    """Latest transform of each frame to its parent."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, NDArray[np.float64]]] = {}

    def add(self, message: Any) -> None:
        """Store the transforms of a `tf2_msgs/TFMessage`, except those that are not a rotation and translation."""
        for one in message.transforms:
            shift, turn = one.transform.translation, one.transform.rotation
            matrix = np.eye(4)
            matrix[:3, :3] = rotations_from_quaternions(np.array([turn.w, turn.x, turn.y, turn.z]))
            matrix[:3, 3] = shift.x, shift.y, shift.z
            if np.isfinite(matrix).all():
                self._parents[_plain(one.child_frame_id)] = _plain(one.header.frame_id), matrix

    def between(self, source: str, target: str) -> NDArray[np.float64] | None:
        """Return the (4, 4) matrix, metres, from one frame to another; None if they are not connected."""
        from_source, from_target = self._upwards(_plain(source)), self._upwards(_plain(target))
        for frame, matrix in from_source.items():
            if frame in from_target:
                return np.asarray(np.linalg.inv(from_target[frame]) @ matrix)
        return None

    @property
    def frames(self) -> list[str]:
        """Names of all frames, sorted."""
        return sorted({*self._parents, *(parent for parent, _ in self._parents.values())})

    def _upwards(self, frame: str) -> dict[str, NDArray[np.float64]]:
        """Return the matrices from the frame to itself, its parent and all further ancestors."""
        matrix = np.eye(4)
        found = {frame: matrix}
        while frame in self._parents:
            frame, step = self._parents[frame]
            if frame in found:  # a cycle
                break
            matrix = step @ matrix
            found[frame] = matrix
        return found


def read_static_transforms(recording: Recording, frame: str) -> Transforms:
    """Read the transforms of a recording's `/tf_static` in any namespace.

    Args:
        recording: to read from.
        frame: frame that is needed later.

    Raises:
        ScanError: there is no such topic, none of its messages can be read, or they do not name the frame.
    """
    instead = "say how the scans lie by --axes or --pose instead of --frame"
    topics = [
        one.name
        for one in recording.topics
        if one.name.rpartition("/")[2] == _STATIC and one.type in TRANSFORM_TYPES and one.messages
    ]
    if not topics:
        raise ScanError(f"{recording.path}: no messages on /{_STATIC} (tf2_msgs/msg/TFMessage); {instead}")
    transforms, trouble = Transforms(), ""
    for topic in topics:
        for message in recording.messages(topic):
            try:
                transforms.add(decode_message(message, TRANSFORM_TYPES[0]))
            except Exception as error:  # the library does not catch struct's errors
                trouble = f" ({reason(error)})"
    if _plain(frame) not in transforms.frames:
        known = ", ".join(transforms.frames)[:200] or f"no frame{trouble}"
        raise ScanError(f"{recording.path}: {', '.join(topics)} names no {frame[:80]}; there is {known}, or {instead}")
    return transforms


def _plain(frame: str) -> str:
    """Return a frame's name without the leading slash of ROS 1."""
    return str(frame).lstrip("/")
