"""Transforms between the frames of a vehicle: ROS' tf, and poses from nav_msgs/Odometry, interpolated in time."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ScanError
from asca_pillars.geometry.frame_change import rotations_from_quaternions
from asca_pillars.scans.recordings.messages import decode_message, time_of
from asca_pillars.scans.recordings.recording import Recording, reason

TRANSFORM_TYPES = ("tf2_msgs/msg/TFMessage", "tf2_msgs/TFMessage", "tf/msg/tfMessage", "tf/tfMessage")
_STATIC = "tf_static"


class Transforms:
    """Latest transform of each frame to its parent."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, NDArray[np.float64]]] = {}

    def add(self, message: Any) -> None:
        """Store the transforms of a `tf2_msgs/TFMessage`, except those that are not a rotation and translation."""
        for transform in message.transforms:
            shift, turn = transform.transform.translation, transform.transform.rotation
            matrix = np.eye(4)
            matrix[:3, :3] = rotations_from_quaternions(np.array([turn.w, turn.x, turn.y, turn.z]))
            matrix[:3, 3] = shift.x, shift.y, shift.z
            if np.isfinite(matrix).all():
                self._parents[_plain(transform.child_frame_id)] = _plain(transform.header.frame_id), matrix

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
        matrices = {frame: matrix}
        while frame in self._parents:
            frame, step = self._parents[frame]
            if frame in matrices:  # a cycle
                break
            matrix = step @ matrix
            matrices[frame] = matrix
        return matrices


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
        listed.name
        for listed in recording.topics
        if listed.name.rpartition("/")[2] == _STATIC and listed.type in TRANSFORM_TYPES and listed.messages
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


_Doubles = NDArray[np.float64]

ODOMETRY_TYPES = ("nav_msgs/msg/Odometry", "nav_msgs/Odometry")

_TOO_LARGE = 1e9  # of any number, metres: larger than any map

BEYOND_NS = 200_000_000
"""Largest time by which a scan may precede the first or follow the last pose: two scans at 10 Hz."""


@dataclass(frozen=True)
class Poses:
    """N poses by time, of the odometry's child frame in a fixed frame."""

    times_ns: NDArray[np.int64]
    """(N,) ascending."""
    positions_m: _Doubles
    """(N, 3)."""
    quaternions: _Doubles
    """(N, 4) w, x, y, z unit quaternions, of the two signs the one nearer to the pose before."""

    def covers(self, time_ns: int) -> bool:
        """Return whether a time is between the first and the last pose, up to BEYOND_NS."""
        return bool(self.times_ns[0] - BEYOND_NS <= time_ns <= self.times_ns[-1] + BEYOND_NS)

    def at(self, time_ns: int) -> _Doubles:
        """Return the (4, 4) matrix, metres, at a time: interpolated between two poses, outside of all the nearest."""
        after = int(np.clip(np.searchsorted(self.times_ns, time_ns), 1, max(len(self.times_ns) - 1, 1)))
        before = min(after - 1, len(self.times_ns) - 1)
        after = min(after, len(self.times_ns) - 1)
        span = int(self.times_ns[after] - self.times_ns[before])
        share = float(np.clip((time_ns - int(self.times_ns[before])) / span, 0.0, 1.0)) if span else 0.0
        matrix = np.eye(4)
        matrix[:3, 3] = (1 - share) * self.positions_m[before] + share * self.positions_m[after]
        turn = (1 - share) * self.quaternions[before] + share * self.quaternions[after]
        matrix[:3, :3] = rotations_from_quaternions(turn)
        return matrix


def read_poses(recording: Recording, topic: str) -> Poses:
    """Read all poses of a topic.

    Raises:
        ScanError: there is no such topic, it holds something else, or none of its poses can be used.
    """
    kinds = {listed.name: listed.type for listed in recording.topics}
    if kinds.get(topic) not in ODOMETRY_TYPES:
        odometry_topics = ", ".join(name for name, kind in kinds.items() if kind in ODOMETRY_TYPES) or "no such topic"
        raise ScanError(f"{recording.path}: {topic[:80]} holds no nav_msgs/msg/Odometry; there is {odometry_topics}")
    rows, trouble = [], "no message"
    for message in recording.messages(topic):
        try:
            odometry = decode_message(message, ODOMETRY_TYPES[0])
        except Exception as error:  # the library does not catch struct's errors
            trouble = reason(error)
            continue
        pose, time_ns = odometry.pose.pose, time_of(odometry.header, message)
        place, turn = pose.position, pose.orientation
        row = [place.x, place.y, place.z, turn.w, turn.x, turn.y, turn.z]
        if time_ns is None:
            trouble = "no usable time stamp"
        elif (np.abs(row) < _TOO_LARGE).all() and np.linalg.norm(row[3:]) > 0.5:  # False for NaN
            rows.append((time_ns, row))
        else:
            trouble = "a pose that is not finite or too far away, or no rotation"
    if not rows:
        raise ScanError(f"{recording.path}, {topic}: no pose can be used ({trouble}); leave --odometry out")
    rows.sort(key=lambda row: row[0])
    values = np.array([row for _, row in rows])
    turns = values[:, 3:] / np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
    flips = np.cumprod(np.where((turns[1:] * turns[:-1]).sum(axis=1) < 0, -1.0, 1.0))
    turns[1:] *= flips[:, None]
    return Poses(np.array([time for time, _ in rows]), values[:, :3], turns)
