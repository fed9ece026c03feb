"""ROS' sensor_msgs/PointCloud2: points of any field layout, byte order and padding."""

from typing import Any, NamedTuple

import numpy as np

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings.messages import decode_message, time_of
from asca_pillars.scans.recordings.other_clouds import (
    apply_pose,
    foxglove_cloud,
    livox_cloud,
    packed_points,
    point_cloud,
)
from asca_pillars.scans.recordings.packet_files import velodyne_scan
from asca_pillars.scans.recordings.recording import Message, ScanKind, reason
from asca_pillars.scans.records import MAX_POINTS, Field, StoredPoints, assemble_points, select_fields

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
        raise ScanError(f"{source}: no readable {name} ({reason(error)}); record it again") from None
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
