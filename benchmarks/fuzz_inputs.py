"""Inputs of `benchmarks.fuzz`: every reader, with small files that it accepts."""

import io
import json
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from asca_deploy import default_bundle_path
from asca_deploy.manifest import load_pillar_bundle
from asca_pillars.base.errors import ScanError
from asca_pillars.base.schema import to_dict
from asca_pillars.base.settings import shipped_configs
from asca_pillars.config.tree import Config, load_config
from asca_pillars.data.boxes.box_records import read_frame_file, read_frames, read_time
from asca_pillars.data.kitti import KittiSplit, boxes_from_objects, objects_3d, read_calibration, read_labels
from asca_pillars.evaluation.predictions import read_predictions, read_truth
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec
from asca_pillars.scans.mounting import read_pose
from asca_pillars.scans.recordings.recorded_scans import RecordedScans, open_recording
from asca_pillars.scans.scan_reader import read_scan
from asca_pillars.scans.transforms import read_poses
from asca_pillars.sim.simulation import load_simulation_config
from benchmarks.made_recordings import TOPIC, TYPE, point_cloud2
from tests.helpers.scenes import write_dataset
from tests.scans.recordings.cloud_recordings import ODOMETRY, cloud_points, odometry_message, stamps, store
from tests.scans.scan_files import POINTS, las, laz, npy, pcd, ply, text

BOX = {"class": "Car", "x_m": 9.5, "y_m": -2, "z_m": -0.9, "length_m": 4, "width_m": 1.8, "height_m": 1.6, "yaw_rad": 3}
METADATA = b"""rosbag2_bagfile_information:
  version: 5
  storage_identifier: sqlite3
  relative_file_paths: [bag_0.db3]
  topics_with_message_count:
    - topic_metadata: {name: /points, type: sensor_msgs/msg/PointCloud2, serialization_format: cdr}
      message_count: 3
  compression_format: ""
  compression_mode: ""
"""
# Pages are small, so that damage strikes messages as well as free space.
_SCHEMA = """PRAGMA page_size = 512;
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, offered_qos_profiles TEXT);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);"""
_TOPICS = {TOPIC: TYPE, "/odom": ODOMETRY}


@dataclass(frozen=True)
class Kind:
    """Kind of input: the file to write, valid contents, and its reader, which returns its numbers."""

    name: str
    path: Path
    seeds: tuple[bytes, ...]
    read: Callable[[Path], Any]
    share: float = 1.0
    is_scan: bool = False


def kinds(folder: Path) -> list[Kind]:
    """Return every kind of input of a command; the files of each are written below `folder`."""
    training = write_dataset(folder / "root", 2) / "training"
    label, calibration = ((training / name / "000000.txt").read_text() for name in ("label_2", "calib"))
    camera, truth = read_calibration(training / "calib" / "000000.txt"), read_truth(training / "label_2", ["000000"])
    plain, bundle = folder / "plain.yaml", folder / "bundle"
    plain.write_text("name: plain\n")
    bundle.mkdir()
    for graph in default_bundle_path().glob("*.onnx"):
        (bundle / graph.name).symlink_to(graph.resolve())
    manifest = json.dumps(json.loads((default_bundle_path() / "bundle.json").read_text())).encode()

    def calibrated(path: Path) -> Any:
        found = read_calibration(path)
        return [found.p2, found.r0_rect, found.camera_from_lidar]

    def predictions(path: Path) -> Any:
        return [frame.scores for frame in read_predictions(path.parent, truth, training / "label_2").detections]

    labels = label.encode(), label.replace("Car", "DontCare").encode(), b"", label.replace(" 0.00 ", " -1 ").encode()
    scored = "".join(f"{line} 0.9\n" for line in label.splitlines()).encode(), b""
    overrides = b"train.epochs=20", b"model.spec.grid.x_range_m=[0, 61.44]", b"augment.insert.proportions={Car: 1}"
    sections = [yaml.safe_dump({key: value}, sort_keys=False).encode() for key, value in to_dict(Config()).items()]
    configs = (b"augment: {scale: [1, 2]}\n", *sections, *(p.read_bytes() for p in shipped_configs().values()))
    simulations = tuple(path.read_bytes() for path in shipped_configs("simulation").values())
    records = (
        ("json", json.dumps({"time_s": 1.5, "boxes": [BOX, BOX]}), lambda p: (read_frame_file(p).boxes, read_time(p))),
        ("jsonl", json.dumps({"scan": "a.bin", "boxes": [BOX]}) + "\n", _named_boxes),
        ("csv", f"scan,{','.join(BOX)}\na.bin,{','.join(map(str, BOX.values()))}\n", _named_boxes),
    )
    recordings = recording_seeds()
    (folder / "bag").mkdir()
    (folder / "bag" / "bag_0.db3").write_bytes(recordings["db3"][0])
    return [
        *(Kind(f"scan .{s}", folder / f"scan.{s}", of, read_points, 4, is_scan=True) for s, of in scan_seeds().items()),
        *(Kind(f"recording .{s}", folder / f"drive.{s}", of, read_recording, 2) for s, of in recordings.items()),
        *(Kind(f"boxes .{s}", folder / f"boxes.{s}", (text.encode(),), reader) for s, text, reader in records),
        Kind("metadata.yaml", folder / "bag" / "metadata.yaml", (METADATA,), lambda p: read_recording(p.parent), 0.5),
        Kind("pose", folder / "pose.txt", (b"1 0 0 0\n0 1 0 0\n0 0 1 1.7\n0 0 0 1\n",), read_pose, 0.5),
        Kind("config", folder / "config.yaml", configs, lambda p: _numbers(load_config(p)), 0.25),
        Kind("simulation", folder / "sim.yaml", simulations, lambda p: to_dict(load_simulation_config(str(p))), 0.2),
        Kind("override", folder / "override.txt", overrides, lambda p: _numbers(load_config(plain, [_text(p)])), 0.5),
        Kind(
            "labels", folder / "label.txt", labels, lambda p: boxes_from_objects(objects_3d(read_labels(p)), camera), 2
        ),
        Kind("calibration", folder / "calibration.txt", (calibration.encode(),), calibrated, 2),
        Kind("predictions", folder / "found" / "000000.txt", scored, predictions, 2),
        Kind("ImageSets", folder / "root" / "ImageSets" / "own.txt", (b"000000\n000001\n",), _frames, 2),
        Kind("manifest", bundle / "bundle.json", (manifest,), lambda p: to_dict(load_pillar_bundle(p.parent)), 0.2),
    ]


def read_points(path: Path) -> Any:
    """Read the points of a scan."""
    return read_scan(path).points


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
        poses = read_poses(recording, "/odom")
        found += [poses.times_ns, poses.positions_m, poses.quaternions]
    except ScanError:
        pass
    recording.point_cloud_topic()
    return found


def _named_boxes(path: Path) -> Any:
    return [frame.records.boxes for frame in read_frames(path)]


def _frames(path: Path) -> Any:
    return len(KittiSplit(path.parent.parent, path.stem).frame_ids)


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace")


def _numbers(config: Config) -> Any:
    """Return the numbers of a config, and those of its grid."""
    spec = config.model.spec
    return to_dict(config), spec.anchors.shape[:2] if isinstance(spec, VoxelSpec) else (spec.grid.nx, spec.grid.ny)


def scan_seeds() -> dict[str, tuple[bytes, ...]]:
    """Return small valid scans of each format and encoding, by suffix."""
    return {
        "bin": (POINTS.tobytes(), np.column_stack([POINTS, POINTS[:, :1]]).tobytes()),
        "npy": tuple(npy(array) for array in (POINTS, POINTS.astype("f8"), (POINTS * 100).astype("i2"))),
        "pcd": tuple(pcd(encoding) for encoding in ("ascii", "binary", "binary_compressed")),
        "ply": tuple(ply(encoding) for encoding in ("ascii", "binary_little_endian", "binary_big_endian")),
        "las": (las(),),
        "laz": (laz(),),
        "csv": (text(), text(",", "x,y,z,intensity\n"), text(";", "# X (m);Y (m);Z (m);Reflectivity\n")),
    }


def recording_seeds() -> dict[str, tuple[bytes, ...]]:
    """Return recordings of three scans and three poses, by suffix."""
    import zstandard
    from mcap.writer import CompressionType, IndexType
    from rosbags.rosbag1 import Writer

    plain = CompressionType.NONE
    mcaps = (
        _mcap(),
        _mcap(compression=CompressionType.LZ4, enable_crcs=False),  # with checksums, changed contents are not decoded
        _mcap(compression=plain, enable_crcs=False),
        _mcap(compression=plain, enable_crcs=False, index_types=IndexType.NONE),
        _mcap(enable_crcs=False, repeat_channels=False, repeat_schemas=False),
        _mcap(enable_crcs=False, use_chunking=False),
    )
    databases = _database(lambda data: data), _database(zstandard.compress)
    return {
        "mcap": mcaps,
        "db3": databases,
        "bag": tuple(_bag(compression) for compression in (None, *Writer.CompressionFormat)),
        "mcap.zst": tuple(map(zstandard.compress, mcaps[:2])),
        "db3.zstd": tuple(map(zstandard.compress, databases)),
    }


def _messages() -> Iterator[tuple[str, int, bytes]]:
    """Yield (topic, time, CDR) of alternating scans and poses; the first scan has no time stamp of its own."""
    types = store()
    for number, time_ns in enumerate(stamps(3)):
        cloud = point_cloud2(types, time_ns if number else 0, cloud_points(number, 6))
        yield TOPIC, time_ns, bytes(types.serialize_cdr(cloud, TYPE))
        yield "/odom", time_ns, bytes(types.serialize_cdr(odometry_message(time_ns, number), ODOMETRY))


def _mcap(**options: Any) -> bytes:
    from mcap.writer import Writer

    file = io.BytesIO()
    writer = Writer(file, chunk_size=400, **options)
    writer.start(profile="ros2", library="fuzz")
    channels = {
        topic: writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", b""))
        for topic, kind in _TOPICS.items()
    }
    for topic, time_ns, data in _messages():
        writer.add_message(channels[topic], time_ns, data, time_ns)
    writer.finish()
    return file.getvalue()


def _database(packed: Callable[[bytes], bytes]) -> bytes:
    with closing(sqlite3.connect(":memory:")) as database:
        database.executescript(_SCHEMA)
        for number, (topic, kind) in enumerate(_TOPICS.items()):
            database.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", (number, topic, kind))
        for topic, time_ns, data in _messages():
            row = list(_TOPICS).index(topic), time_ns, packed(data)
            database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", row)
        database.commit()
        return database.serialize()


def _bag(compression: Any) -> bytes:
    from rosbags.rosbag1 import Writer

    types = store(ros1=True)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.bag")
        writer = Writer(path)
        writer.chunk_threshold = 400
        if compression is not None:
            writer.set_compression(compression)
        with writer:
            connections = {
                topic: writer.add_connection(topic, kind, typestore=types) for topic, kind in _TOPICS.items()
            }
            for topic, time_ns, data in _messages():
                writer.write(connections[topic], time_ns, bytes(store().cdr_to_ros1(data, _TOPICS[topic])))
        return path.read_bytes()
