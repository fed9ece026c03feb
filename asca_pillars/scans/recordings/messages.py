"""Messages of standard ROS types as objects, by the library rosbags."""

from functools import cache
from typing import Any

from asca_pillars.scans.recordings.decompression import ZSTD_MAGIC, decompress_zstd
from asca_pillars.scans.recordings.recording import Encoding, Message

_OTHER_TYPES = {
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",  # ROS 1's common messages do not have it
    "ouster_sensor_msgs/msg/PacketMsg": "uint8[] buf",
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets",
}
"""Types that are no part of the library's stores."""


def decode_message(message: Message, kind: str) -> Any:
    """A stored message of a type such as sensor_msgs/msg/PointCloud2, by ROS' own definitions.

    Raises:
        Exception: it is damaged; the library lets struct's and NumPy's errors pass.
    """
    store = typestore(message.encoding)
    if message.encoding == "ros1":
        return store.deserialize_ros1(message.data, kind)
    if message.encoding != "cdr":
        raise ValueError(f"encoded as {message.encoding}; cdr and ros1 are read")
    return store.deserialize_cdr(decompress_message(message), kind)


def decompress_message(message: Message) -> bytes:
    """The bytes of a message; rosbag2 says in its metadata.yaml alone that it compressed them.

    Raises:
        Exception: they are damaged.
    """
    # No CDR begins so.
    return decompress_zstd(message.data) if message.data.startswith(ZSTD_MAGIC) else message.data


def time_of(header: Any, message: Message) -> int | None:
    """When a message was measured, nanoseconds: by its header, or where that says 0 or less when it was recorded.

    None if neither is known.
    """
    time_ns = int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
    return time_ns if time_ns > 0 else message.recorded_ns


@cache
def typestore(encoding: Encoding) -> Any:
    """The standard definitions; those types that are read here have not changed since ROS 1."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    for name, definition in _OTHER_TYPES.items():
        if name not in store.types:
            store.register(get_types_from_msg(definition, name))
    return store
