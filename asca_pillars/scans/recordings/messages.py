"""Decoding of messages of standard ROS types, with the library rosbags."""

from functools import cache
from typing import Any

from asca_pillars.scans.recordings.decompression import ZSTD_MAGIC, decompress_zstd
from asca_pillars.scans.recordings.recording import Encoding, Message

_OTHER_TYPES = {
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",  # not among ROS 1's common messages
    "ouster_sensor_msgs/msg/PacketMsg": "uint8[] buf",
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets",
}
"""Types that the library does not define."""


def decode_message(message: Message, kind: str) -> Any:
    """Decode a stored message of a type such as sensor_msgs/msg/PointCloud2 by ROS' own definitions.

    Raises:
        Exception: it is damaged; the library does not catch struct's and NumPy's errors.
    """
    store = typestore(message.encoding)
    if message.encoding == "ros1":
        return store.deserialize_ros1(message.data, kind)
    if message.encoding != "cdr":
        raise ValueError(f"encoded as {message.encoding}; cdr and ros1 are read")
    return store.deserialize_cdr(decompress_message(message), kind)


def decompress_message(message: Message) -> bytes:
    """Return the bytes of a message; rosbag2 states its compression in its metadata.yaml alone.

    Raises:
        Exception: they are damaged.
    """
    # CDR cannot begin with these bytes.
    return decompress_zstd(message.data) if message.data.startswith(ZSTD_MAGIC) else message.data


def time_of(header: Any, message: Message) -> int | None:
    """Return the time stamp of a message, nanoseconds: of its header, or if that is 0 or less of its recording.

    None if neither is known.
    """
    time_ns = int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
    return time_ns if time_ns > 0 else message.recorded_ns


@cache
def typestore(encoding: Encoding) -> Any:
    """Return the standard definitions; the types read here have not changed since ROS 1."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    for name, definition in _OTHER_TYPES.items():
        if name not in store.types:
            store.register(get_types_from_msg(definition, name))
    return store
