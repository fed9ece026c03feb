"""Small recordings made here: PointCloud2 of any layout in MCAP, rosbag2 and ROS 1 bags."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from asca_pillars.scans.recordings.messages import typestore
from asca_pillars.scans.recordings.recorded_scans import RecordedScan, RecordedScans, open_recording
from benchmarks.made_recordings import point_cloud2

CLOUD = "sensor_msgs/msg/PointCloud2"
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
START_NS = 1_700_000_000_000_000_000


def cloud_points(seed: int, count: int = 50) -> NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    return rng.uniform([2, -5, -1.7, 0], [30, 5, 1, 1], (count, 4)).astype(np.float32)


def stamps(count: int) -> list[int]:
    return [START_NS + index * 100_000_000 for index in range(count)]


def store(ros1: bool = False) -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)


def serialized(message: Any, kind: str, *, ros1: bool = False, one: Any = None) -> bytes:
    """A message's bytes; `one` is a store with types that others have not."""
    one = one or typestore("ros1" if ros1 else "cdr")
    return bytes(one.serialize_ros1(message, kind) if ros1 else one.serialize_cdr(message, kind))


def header(types: Any, time_ns: int, frame_id: str, *, ros1: bool = False) -> Any:
    stamp = types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    return types["std_msgs/msg/Header"](**({"seq": 0} if ros1 else {}), stamp=stamp, frame_id=frame_id)


def read_scans(path: Path, topic: str | None = None, *, start: int = 0) -> list[RecordedScan]:
    recording = open_recording(path)
    return list(RecordedScans(recording, recording.point_cloud_topic(topic), 1.0).read(start))


def laid_out(
    points: NDArray[np.float32],
    *,
    layout: list[tuple[str, str, int]] | None = None,
    step: int = 16,
    rows: int = 1,
    row_padding: int = 0,
    big_endian: bool = False,
    time_ns: int = START_NS,
) -> Any:
    """A PointCloud2 whose fields (name, NumPy type without byte order, offset) hold the columns in order."""
    layout = layout or [("x", "f4", 0), ("y", "f4", 4), ("z", "f4", 8), ("intensity", "f4", 12)]
    order = ">" if big_endian else "<"
    types = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
    names, kinds, offsets = (list(part) for part in zip(*layout, strict=True))
    formats = [order + kind for kind in kinds]
    packed = np.zeros(len(points), {"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    for index, (name, _, _) in enumerate(layout):
        packed[name] = points[:, index]
    width = len(points) // rows
    table = np.full((rows, width * step + row_padding), 0xAB, np.uint8)
    table[:, : width * step] = packed.view(np.uint8).reshape(rows, width * step)
    one = store()
    message = point_cloud2(one, time_ns, points)
    field = one.types["sensor_msgs/msg/PointField"]
    message.fields = [field(name=n, offset=o, datatype=types.index(kind) + 1, count=1) for n, kind, o in layout]
    message.height, message.width, message.point_step = rows, width, step
    message.row_step, message.is_bigendian, message.data = table.shape[1], big_endian, table.reshape(-1)
    return message


def write_mcap(
    path: Path,
    topics: dict[str, list[tuple[int, Any]]],
    *,
    others: dict[str, str] | None = None,
    odometry: list[tuple[int, Any]] | None = None,
    transforms: list[Any] | None = None,
    images: dict[str, tuple[str, str, list[tuple[int, bytes]]]] | None = None,
    chunk_size: int = 2000,
    has_schema: bool = True,
    **options: Any,
) -> Path:
    """An MCAP with topics of (time, PointCloud2 message or raw bytes).

    `others` are topics of other types, `images` topics of (type, encoding, (time, raw bytes)), `options` the writer's.
    """
    from mcap.writer import Writer

    one, schemas = store(), dict[str, int]()
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_size, **options)
        writer.start(profile="ros2", library="test")

        def add(topic: str, kind: str, messages: list[tuple[int, Any]]) -> None:
            if kind not in schemas:
                text = one.generate_msgdef(kind, ros_version=2)[0].encode()
                schemas[kind] = writer.register_schema(kind, "ros2msg", text) if has_schema else 0
            channel = writer.register_channel(topic, "cdr", schemas[kind])
            for time_ns, message in messages:
                data = message if isinstance(message, bytes) else serialized(message, kind)
                writer.add_message(channel, time_ns, data, time_ns)

        for topic, messages in topics.items():
            add(topic, CLOUD, messages)
        for topic, kind in (others or {}).items():
            other = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", b"string data"))
            writer.add_message(other, START_NS, b"\x00\x01\x00\x00\x01\x00\x00\x00\x00", START_NS)
        for topic, (kind, encoding, stored) in (images or {}).items():
            channel = writer.register_channel(topic, encoding, writer.register_schema(kind, "", b""))
            for time_ns, content in stored:
                writer.add_message(channel, time_ns, content, time_ns)
        if odometry:
            add("/odom", ODOMETRY, odometry)
        if transforms:
            add("/tf_static", TRANSFORMS, [(START_NS, message) for message in transforms])
        writer.finish()
    return path


def transform_message(parent: str, child: str, matrix: NDArray[np.float64], *, ros1: bool = False) -> Any:
    """A TFMessage with the pose (4, 4), metres, of the child in its parent."""
    types = typestore("ros1" if ros1 else "cdr").types
    x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()
    shift = types["geometry_msgs/msg/Vector3"](*matrix[:3, 3].tolist())
    turn = types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
    stamped = types["geometry_msgs/msg/TransformStamped"](
        header=header(types, 0, parent, ros1=ros1),
        child_frame_id=child,
        transform=types["geometry_msgs/msg/Transform"](translation=shift, rotation=turn),
    )
    return types[TRANSFORMS](transforms=[stamped])


def odometry_message(
    time_ns: int, x_m: float, yaw_rad: float = 0.0, *, roll_rad: float = 0.0, pitch_rad: float = 0.0
) -> Any:
    """At x_m on the x axis, turned about x by roll, then about y by pitch, then about z by yaw."""
    types = store().types
    vector, covariance = types["geometry_msgs/msg/Vector3"], np.zeros(36)
    x, y, z, w = Rotation.from_euler("xyz", [roll_rad, pitch_rad, yaw_rad]).as_quat().tolist()
    turn = types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=x_m, y=0.0, z=0.0), orientation=turn
    )
    twist = types["geometry_msgs/msg/Twist"](linear=vector(x=0.0, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=0.0))
    return types[ODOMETRY](
        header=header(types, time_ns, "odom"),
        child_frame_id="base_link",
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=covariance),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=covariance),
    )


def image_message(
    time_ns: int, pixels: NDArray[np.uint8], encoding: str, *, padding: int = 0, ros1: bool = False
) -> Any:
    """A sensor_msgs/Image of pixels (height, width, channels) with so many bytes behind each row."""
    types = store(ros1).types
    height, width, channels = pixels.shape
    rows = np.pad(pixels.reshape(height, -1), ((0, 0), (0, padding)))
    return types["sensor_msgs/msg/Image"](
        header=header(types, time_ns, "camera", ros1=ros1),
        height=height, width=width, encoding=encoding, is_bigendian=0, step=width * channels + padding,
        data=rows.reshape(-1),
    )  # fmt: skip


def compressed_image(time_ns: int, content: bytes, format_: str = "jpeg") -> bytes:
    """A sensor_msgs/CompressedImage in CDR."""
    types, kind = store().types, "sensor_msgs/msg/CompressedImage"
    message = types[kind](header(types, time_ns, "camera"), format_, np.frombuffer(content, np.uint8))
    return serialized(message, kind)


def clouds(count: int, points: int = 50) -> list[tuple[int, Any]]:
    """(time, message) of as many scans."""
    one = store()
    times = enumerate(stamps(count))
    return [(time_ns, point_cloud2(one, time_ns, cloud_points(seed, points))) for seed, time_ns in times]
