"""Small valid recordings of each kind for `benchmarks.fuzz`, and their reader."""

import io
import sqlite3
import tempfile
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings.odometry import read_poses
from asca_pillars.scans.recordings.open_recording import open_recording
from asca_pillars.scans.recordings.recorded_scans import RecordedScans
from benchmarks.made_recordings import TOPIC, TYPE, point_cloud2

ODOMETRY_TOPIC, ODOMETRY = "/odom", "nav_msgs/msg/Odometry"
_SCANS = 3
_SCHEMA = """PRAGMA page_size = 512;
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, offered_qos_profiles TEXT);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);"""


def recording_seeds() -> dict[str, tuple[bytes, ...]]:
    """Return recordings of three scans and three poses, by suffix."""
    import zstandard

    mcaps, databases = _mcaps(), _databases()
    return {
        "mcap": mcaps,
        "db3": databases,
        "bag": _bags(),
        "mcap.zst": tuple(zstandard.compress(content) for content in mcaps[:2]),
        "db3.zstd": tuple(zstandard.compress(content) for content in databases),
    }


def read_recording(path: Path) -> Any:
    """Read the points of all scans, their times, and the poses, of every topic that may have any."""
    recording = open_recording(path)
    found: list[Any] = []
    for topic in recording.topics:
        if topic.is_point_cloud or topic.type == "unknown":
            scans = list(RecordedScans(recording, topic, "auto").read())
            found += [scan.scan.points for scan in scans if scan.scan is not None]
            found.append(np.array([scan.time_ns for scan in scans], np.int64))
    try:
        poses = read_poses(recording, ODOMETRY_TOPIC)
        found += [poses.times_ns, poses.positions_m, poses.quaternions]
    except ScanError:
        pass
    recording.point_cloud_topic()
    return found


def _messages(ros1: bool = False) -> list[tuple[str, int, bytes]]:
    """Return (topic, time, data) of alternating scans and poses."""
    store = _store(ros1)
    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
    rng = np.random.default_rng(0)
    messages = []
    for number in range(_SCANS):
        time_ns = (number + 1) * 10**8
        points = rng.uniform((-50, -50, -2, 0), (50, 50, 2, 1), (6, 4)).astype(np.float32)
        cloud = point_cloud2(store, time_ns if number else 0, points)  # one without a time stamp
        messages.append((TOPIC, time_ns, bytes(serialize(cloud, TYPE))))
        messages.append((ODOMETRY_TOPIC, time_ns, bytes(serialize(_odometry(store, time_ns), ODOMETRY))))
    return messages


def _odometry(store: Any, time_ns: int) -> Any:
    types, covariance = store.types, np.zeros(36)
    extra = {"seq": 0} if "seq" in types["std_msgs/msg/Header"].__dataclass_fields__ else {}
    stamp = types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    vector = types["geometry_msgs/msg/Vector3"](x=1.0, y=0.0, z=0.0)
    point = types["geometry_msgs/msg/Point"](x=time_ns * 1e-9, y=0.0, z=0.0)
    pose = types["geometry_msgs/msg/Pose"](
        position=point, orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    )
    return types[ODOMETRY](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="odom", **extra),
        child_frame_id="base_link",
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=covariance),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](
            twist=types["geometry_msgs/msg/Twist"](linear=vector, angular=vector), covariance=covariance
        ),
    )


def _store(ros1: bool) -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)


def _mcaps() -> tuple[bytes, ...]:
    """Return files with and without checksums: with a checksum, changed contents are never decoded."""
    from mcap.writer import CompressionType, IndexType

    return (
        _mcap(),
        _mcap(compression=CompressionType.LZ4, enable_crcs=False),
        _mcap(compression=CompressionType.NONE, enable_crcs=False),
        _mcap(compression=CompressionType.NONE, enable_crcs=False, index_types=IndexType.NONE),
        _mcap(enable_crcs=False, repeat_channels=False, repeat_schemas=False),
        _mcap(enable_crcs=False, use_chunking=False),
    )


def _mcap(**options: Any) -> bytes:
    from mcap.writer import Writer

    file = io.BytesIO()
    writer = Writer(file, chunk_size=400, **options)
    writer.start(profile="ros2", library="fuzz")
    channels = {
        topic: writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", b""))
        for topic, kind in ((TOPIC, TYPE), (ODOMETRY_TOPIC, ODOMETRY))
    }
    for topic, time_ns, data in _messages():
        writer.add_message(channels[topic], time_ns, data, time_ns)
    writer.finish()
    return file.getvalue()


def _databases() -> tuple[bytes, ...]:
    """Return files with plain and with compressed messages."""
    import zstandard

    found = []
    for packed in (False, True):
        with closing(sqlite3.connect(":memory:")) as database:
            database.executescript(_SCHEMA)
            for number, (topic, kind) in enumerate(((TOPIC, TYPE), (ODOMETRY_TOPIC, ODOMETRY)), start=1):
                database.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", (number, topic, kind))
            for topic, time_ns, data in _messages():
                row = 1 + (topic == ODOMETRY_TOPIC), time_ns, zstandard.compress(data) if packed else data
                database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", row)
            database.commit()
            found.append(database.serialize())
    return tuple(found)


def _bags() -> tuple[bytes, ...]:
    from rosbags.rosbag1 import Writer

    found, store = [], _store(ros1=True)
    for compression in (None, *Writer.CompressionFormat):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "a.bag")
            writer = Writer(path)
            writer.chunk_threshold = 400
            if compression is not None:
                writer.set_compression(compression)
            with writer:
                connections = {
                    topic: writer.add_connection(topic, kind, typestore=store)
                    for topic, kind in ((TOPIC, TYPE), (ODOMETRY_TOPIC, ODOMETRY))
                }
                for topic, time_ns, data in _messages(ros1=True):
                    writer.write(connections[topic], time_ns, data)
            found.append(path.read_bytes())
    return tuple(found)
