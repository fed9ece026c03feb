"""Types of messages that hold a sensor's scans and are not PointCloud2, and how to convert recordings of them."""

import re

_REPLAY = "play the recording through the sensor's driver and record the PointCloud2 that it publishes"
_CONVERSIONS = (
    # None: no scans of a lidar in 3D.
    (r"sensor_msgs/(msg/)?(Multi\w*)?LaserScan|radar_\w*/.*", None),
    (
        r"livox_\w+/(msg/)?CustomMsg",
        "record with the driver's xfer_format 0, which is PointCloud2, or convert it (livox_to_pointcloud2)",
    ),
    (r"velodyne_msgs/(msg/)?VelodyneScan", f"{_REPLAY} (velodyne_pointcloud, topic /velodyne_points)"),
    (r"ouster_\w+/(msg/)?PacketMsg", f"{_REPLAY} (replay.launch of ouster_ros, topic /ouster/points)"),
    (r"sensor_msgs/(msg/)?PointCloud", "convert it to PointCloud2 (ROS' package point_cloud_converter)"),
    (r"foxglove(\.|_msgs/(msg/)?)PointCloud", "record the PointCloud2 that it was made of"),
    (r".*(Scans?|Packets?|PacketMsg|UdpFrame|PointCloud\d?|CustomMsg)", _REPLAY),
)


def conversion_of(type_name: str) -> str | None:
    """Advice on making PointCloud2 of scans of a type; None if it is not known to hold scans."""
    return next((remedy for pattern, remedy in _CONVERSIONS if re.fullmatch(pattern, type_name)), None)
