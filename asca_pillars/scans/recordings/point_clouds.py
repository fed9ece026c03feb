"""Messages with points: sensor_msgs/PointCloud2 of any field layout, byte order and padding, and other types.

These are sensor_msgs/PointCloud, Livox' CustomMsg, foxglove.PointCloud and CompressedImage, with the layouts of their
public definitions (common_interfaces, livox_ros_driver2, foxglove/schemas).
"""

import base64
import binascii
import json
import struct
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from asca_pillars.base.errors import ScanError
from asca_pillars.geometry.frame_change import rotations_from_quaternions, transform_points
from asca_pillars.scans.recordings.messages import decode_message, decompress_message, time_of
from asca_pillars.scans.recordings.packet_files import velodyne_scan
from asca_pillars.scans.recordings.recording import Message, ScanKind, reason
from asca_pillars.scans.records import MAX_POINTS, Field, StoredPoints, assemble_points, select_fields

# foxglove.NumericType to the datatypes of sensor_msgs/PointField
_NUMERIC = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8}
_FLOAT, _BYTE = np.dtype("<f4"), np.dtype("u1")
_LIVOX = ("offset_time", "x", "y", "z", "reflectivity", "tag", "line")
_REFLECTANCE = ("intensity", "intensities", "reflectance", "reflectivity", "i")


def point_cloud(message: Message) -> tuple[Any, StoredPoints]:
    """Return header and points of a stored sensor_msgs/PointCloud.

    Raises:
        Exception: it is damaged.
    """
    cloud = decode_message(message, "sensor_msgs/msg/PointCloud")
    xyz = np.array([(point.x, point.y, point.z) for point in cloud.points], np.float32).reshape(-1, 3)
    channel = next((item for name in _REFLECTANCE for item in cloud.channels if item.name.lower() == name), None)
    if channel is None:
        return cloud.header, StoredPoints(xyz, None, None)
    if len(channel.values) != len(xyz):
        raise ValueError(f"{len(channel.values)} values of {channel.name[:40]} for {len(xyz)} points")
    return cloud.header, StoredPoints(xyz, np.asarray(channel.values), _FLOAT)


def livox_cloud(message: Message) -> tuple[Any, StoredPoints]:
    """Return header and points of a stored livox_ros_driver/CustomMsg; reflectivities are 0..255.

    Raises:
        Exception: it is damaged.
    """
    data = decompress_message(message)
    if message.encoding == "ros1":
        _, sec, nanosec, length = struct.unpack_from("<IIII", data)
        name, start, stride = 16, 16 + length + 8 + 4 + 4, 19
        (count,) = struct.unpack_from("<I", data, start)
    else:
        order = "<" if data[1] & 1 else ">"
        if order == ">":
            raise ValueError("its numbers are big-endian")
        sec, nanosec, length = struct.unpack_from("<iII", data, 4)
        name, stride = 16, 20
        start = 4 + -(-(name + length - 4) // 8) * 8 + 8 + 4 + 4  # uint64 is aligned, 4 bytes of CDR first
        (count,) = struct.unpack_from("<I", data, start)
    first = start + 4
    if count > MAX_POINTS or (count and len(data) < first + (count - 1) * stride + 19):
        raise ValueError(f"{len(data)} bytes where {count} points need more")
    places = dict(zip(_LIVOX, (0, 4, 8, 12, 16, 17, 18), strict=True))
    columns = [
        np.ndarray((count,), _BYTE if key == "reflectivity" else _FLOAT, data, first + places[key], (stride,))
        for key in ("x", "y", "z", "reflectivity")
    ] if count else [np.zeros(0, _FLOAT)] * 3 + [np.zeros(0, _BYTE)]  # fmt: skip
    frame_id = data[name : name + length].rstrip(b"\0").decode(errors="replace")
    fields = [Field("x", _FLOAT), Field("y", _FLOAT), Field("z", _FLOAT), Field("reflectivity", _BYTE)]
    header = SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec), frame_id=frame_id)
    return header, assemble_points(count, columns, fields)


def packed_points(message: Message) -> tuple[Any, StoredPoints]:
    """Return header and points of a revolution, in the message format of `packet_files`."""
    table = np.frombuffer(message.data, _FLOAT).reshape(-1, 4)
    header = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="")
    return header, StoredPoints(table[:, :3], table[:, 3], _FLOAT)


def foxglove_cloud(message: Message) -> Any:
    """Decode a foxglove.PointCloud, JSON or Protobuf, as an object with the fields of PointCloud2, and a `pose`.

    Raises:
        Exception: it is damaged.
    """
    content = _of_json(message.data) if message.encoding == "json" else _of_protobuf(message.data)
    stride, data = int(content["point_stride"]), content["data"]
    fields = [
        SimpleNamespace(
            name=field["name"], offset=int(field.get("offset", 0)), datatype=_NUMERIC[int(field["type"])], count=1
        )
        for field in content["fields"]
    ]
    count = len(data) // stride if stride else 0
    sec, nanosec = content["time"]
    header = SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec), frame_id=content["frame_id"])
    return SimpleNamespace(
        header=header, height=1, width=count, point_step=stride, row_step=count * stride, is_bigendian=False,
        fields=fields, data=np.frombuffer(data, np.uint8)[: count * stride], pose=content["pose"],
    )  # fmt: skip


def foxglove_image(message: Message) -> Any:
    """Decode a foxglove.CompressedImage, JSON or Protobuf, as an object like sensor_msgs/CompressedImage.

    Raises:
        Exception: it is damaged.
    """
    if message.encoding == "json":
        content = json.loads(message.data)
        time, data = content.get("timestamp") or {}, base64.b64decode(content["data"], validate=True)
        sec, nanosec, format_ = int(time.get("sec", 0)), int(time.get("nsec", 0)), str(content.get("format", ""))
    else:
        fields = dict(_wire(message.data))
        stamp, data = dict(_wire(fields.get(1, b""))), fields.get(2, b"")
        sec, nanosec, format_ = stamp.get(1, 0), stamp.get(2, 0), fields.get(3, b"").decode(errors="replace")
    header = SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec))
    return SimpleNamespace(header=header, format=format_, data=data)


def apply_pose(points: StoredPoints, pose: Any) -> StoredPoints:
    """Transform points (N, 3) by a foxglove.Pose, (x, y, z, w, x, y, z)."""
    shift, turn = np.array(pose[:3], float), np.array(pose[3:], float)
    if not np.linalg.norm(turn):  # not given
        turn = np.array([1.0, 0, 0, 0])
    matrix = rotations_from_quaternions(turn)
    if np.array_equal(matrix, np.eye(3)) and not shift.any():
        return points
    return points._replace(xyz=transform_points(points.xyz, matrix, shift))


def _of_json(data: bytes) -> dict[str, Any]:
    content = json.loads(data)
    pose = content.get("pose") or {}
    place, turn = pose.get("position") or {}, pose.get("orientation") or {}
    time = content.get("timestamp") or {}
    try:
        body = base64.b64decode(content["data"], validate=True)
    except binascii.Error as error:
        raise ValueError(f"its data are not Base64 ({error})") from None
    return content | {
        "data": body,
        "time": (int(time.get("sec", 0)), int(time.get("nsec", 0))),
        "pose": [*(place.get(key, 0) for key in "xyz"), *(turn.get(key, 0) for key in "wxyz")],
    }


def _of_protobuf(data: bytes) -> dict[str, Any]:
    content: dict[str, Any] = {"frame_id": "", "point_stride": 0, "data": b"", "fields": [], "time": (0, 0)}
    content["pose"] = [0.0] * 7
    for number, value in _wire(data):
        if number == 1:
            time = dict(_wire(value))
            content["time"] = time.get(1, 0), time.get(2, 0)
        elif number == 2:
            content["frame_id"] = value.decode(errors="replace")
        elif number == 3:
            parts = dict(_wire(value))
            place, turn = dict(_wire(parts.get(1, b""))), dict(_wire(parts.get(2, b"")))
            content["pose"] = [
                *(_double(place, key) for key in (1, 2, 3)),
                *(_double(turn, key) for key in (4, 1, 2, 3)),
            ]
        elif number == 4:
            content["point_stride"] = int.from_bytes(value, "little")
        elif number == 5:
            field = dict(_wire(value))
            offset = int.from_bytes(field.get(2, b""), "little")
            content["fields"].append({"name": field[1].decode(), "offset": offset, "type": field.get(3, 0)})
        elif number == 6:
            content["data"] = value
    return content


def _double(fields: dict[int, Any], key: int) -> float:
    return float(struct.unpack("<d", fields[key])[0]) if key in fields else 0.0


def _wire(data: bytes) -> Iterator[tuple[int, Any]]:
    """Yield number and value of each field of a Protobuf message: integers, or bytes of any other type."""
    position = 0
    while position < len(data):
        key, position = _varint(data, position)
        kind = key & 7
        if kind == 0:
            value, position = _varint(data, position)
            yield key >> 3, value
            continue
        if kind == 2:
            size, position = _varint(data, position)
        elif kind in (1, 5):
            size = 8 if kind == 1 else 4
        else:
            raise ValueError(f"a Protobuf field of kind {kind}")
        if position + size > len(data):
            raise ValueError("the message breaks off")
        yield key >> 3, data[position : position + size]
        position += size


def _varint(data: bytes, position: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[position]
        value |= (byte & 0x7F) << shift
        position, shift = position + 1, shift + 7
        if not byte & 0x80:
            return value, position
        if shift > 63:
            raise ValueError("a number of more than 64 bits")


# sensor_msgs/PointField: datatypes 1 to 8.
_DATATYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")


class PointCloud(NamedTuple):
    """Points of a message, with their time stamp and frame."""

    points: StoredPoints
    time_ns: int
    """Time stamp of the header, or if that is 0 or less of the recording; 0, with a remark, if neither is usable."""
    frame_id: str
    fields: tuple[str, ...] = ()
    """Names of a point's fields, where the message lists them."""


def read_point_cloud(message: Message, source: str, kind: ScanKind = "PointCloud2") -> PointCloud:
    """Read the points of a stored message.

    Args:
        message: from a topic of scans.
        source: name in errors.
        kind: message type.

    Raises:
        ScanError: the message is damaged or contradicts itself, or has no x, y and z.
    """
    if not message.data:
        raise ScanError(f"{source}: the message has no data; record it again")
    try:
        header, points, fields = _read(message, source, kind)
    except ScanError:
        raise
    except Exception as error:  # the library does not catch struct's and NumPy's errors
        name = kind if kind.startswith("Point") else f"point cloud of {kind}"
        raise ScanError(f"{source}: not a readable {name} ({reason(error)}); record it again") from None
    time_ns = time_of(header, message)
    if time_ns is None:
        note = "neither the header nor the recording has a usable time stamp, it was taken as 0"
        points, time_ns = points._replace(remarks=(*points.remarks, note)), 0
    return PointCloud(points, time_ns, str(header.frame_id), fields)


def _read(message: Message, source: str, kind: ScanKind) -> tuple[Any, StoredPoints, tuple[str, ...]]:
    """Return header, points, and the names of the fields where the message lists them."""
    if kind == "Packets":
        return *packed_points(message), ()
    if kind == "Velodyne":
        return *velodyne_scan(message), ()
    if kind == "PointCloud":
        return *point_cloud(message), ()
    if kind == "Livox":
        return *livox_cloud(message), ()
    cloud = foxglove_cloud(message) if kind == "Foxglove" else decode_message(message, "sensor_msgs/msg/PointCloud2")
    points, fields = point_cloud_points(cloud, source), tuple(str(field.name) for field in cloud.fields)
    return cloud.header, apply_pose(points, cloud.pose) if kind == "Foxglove" else points, fields


def point_cloud_points(cloud: Any, source: str) -> StoredPoints:
    """Read the points of a PointCloud2 that was decoded by rosbags or received from ROS.

    Args:
        cloud: an object with the fields of that message.
        source: name in errors.

    Raises:
        ScanError: the message contradicts itself, or has no x, y and z.
    """
    height, width, step, row_step = int(cloud.height), int(cloud.width), int(cloud.point_step), int(cloud.row_step)
    count, data = height * width, np.asarray(cloud.data, np.uint8)
    if count > MAX_POINTS:
        raise ScanError(f"{source}: {count} points are more than {MAX_POINTS}; record single scans")
    fields, offsets = [], []
    for field in cloud.fields:
        if not 1 <= field.datatype <= len(_DATATYPES):
            raise ScanError(f"{source}: field {field.name[:40]} has datatype {field.datatype}; there are 1 to 8")
        order = ">" if cloud.is_bigendian else "<"
        # Some drivers write a count of 0 for single values.
        fields.append(
            Field(str(field.name), np.dtype(order + _DATATYPES[field.datatype - 1]), max(int(field.count), 1))
        )
        offsets.append(int(field.offset))
    selected = select_fields(source, fields)
    for index in selected:
        if offsets[index] + fields[index].size_bytes > step:
            raise ScanError(
                f"{source}: field {fields[index].name} at byte {offsets[index]} lies beyond the points' {step} bytes"
            )
    chosen = [fields[index] for index in selected]
    if not count:
        return assemble_points(0, [np.zeros(0, field.dtype) for field in chosen], chosen)
    if height == 1 or len(data) == count * step:
        row_step = width * step  # no padding, whatever a driver writes here: the size of the cloud, the width or 0
    # The last row may lack its padding.
    if row_step < width * step or len(data) < (height - 1) * row_step + width * step:
        raise ScanError(
            f"{source}: {len(data)} bytes where {height} x {width} points of {step} bytes in rows of {row_step} "
            "need more; record it again"
        )
    columns = []
    for index in selected:
        view = np.ndarray((height, width), fields[index].dtype, data, offsets[index], (row_step, step))
        columns.append(view.reshape(-1))
    return assemble_points(count, columns, chosen)
