"""Messages of standard ROS types as objects, by the library rosbags."""

from functools import cache
from typing import Any

from asca_pillars.data.recordings.recording import Encoding, Message


def decoded(message: Message, kind: str) -> Any:
    """A stored message of a type such as sensor_msgs/msg/PointCloud2, by ROS' own definitions.

    Raises:
        Exception: it is damaged; the library lets struct's and NumPy's errors pass.
    """
    store = _typestore(message.encoding)
    deserialize = store.deserialize_ros1 if message.encoding == "ros1" else store.deserialize_cdr
    return deserialize(message.data, kind)


def reason(error: Exception) -> str:
    """An error of a library in one short line."""
    return " ".join(f"{type(error).__name__} {error}".split())[:100]


@cache
def _typestore(encoding: Encoding) -> Any:
    """The standard definitions; those types that are read here have not changed since ROS 1."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
