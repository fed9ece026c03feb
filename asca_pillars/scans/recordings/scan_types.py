"""Message types with a sensor's scans: supported ones, and how to convert recordings of the others."""

import re
from typing import Literal

_REPLAY = "play the recording through the sensor's driver and record the PointCloud2 that it publishes"
_CONVERSIONS = (
    # None: no scans of a 3D LiDAR
    (r"sensor_msgs/(msg/)?(Multi\w*)?LaserScan|radar_\w*/.*", None),
    (r"foxglove_msgs/(msg/)?PointCloud", "record the PointCloud2 that it was made of"),
    (r".*(Scans?|Packets?|PacketMsg|UdpFrame|PointCloud\d?|CustomMsg)", _REPLAY),
)

ScanKind = Literal["PointCloud2", "PointCloud", "Livox", "Foxglove", "Packets", "Velodyne", "Ouster"]
_READ: tuple[tuple[str, ScanKind], ...] = (
    (r"sensor_msgs/(msg/)?PointCloud2", "PointCloud2"),
    (r"sensor_msgs/(msg/)?PointCloud", "PointCloud"),
    (r"livox_\w+/(msg/)?CustomMsg", "Livox"),
    (r"foxglove\.PointCloud", "Foxglove"),
    (r"(velodyne|ouster)/Packets", "Packets"),
    (r"velodyne_msgs/(msg/)?VelodyneScan", "Velodyne"),
    (r"ouster_\w+/(msg/)?PacketMsg", "Ouster"),
)


def kind_of_scans(type_name: str) -> ScanKind | None:
    """Return the kind of scans in messages of a type; None if they are not read as scans."""
    return next((kind for pattern, kind in _READ if re.fullmatch(pattern, type_name)), None)


def conversion_of(type_name: str) -> str | None:
    """Return advice on converting scans of a type to PointCloud2; None if it is not known to hold scans."""
    return next((remedy for pattern, remedy in _CONVERSIONS if re.fullmatch(pattern, type_name)), None)
