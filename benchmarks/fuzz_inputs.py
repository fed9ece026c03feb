"""Seeds of `benchmarks.fuzz`: all readers, with small files that they accept."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from asca_deploy import default_bundle_path
from asca_deploy.manifest import load_pillar_bundle
from asca_pillars.base.schema import to_dict
from asca_pillars.base.settings import shipped_configs
from asca_pillars.config.tree import Config, load_config
from asca_pillars.data.boxes.box_records import read_frame_file, read_frames, read_time
from asca_pillars.data.kitti import KittiSplit, boxes_from_objects, objects_3d, read_calibration, read_labels
from asca_pillars.evaluation.predictions import read_predictions, read_truth
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec
from asca_pillars.scans.mounting import read_pose
from asca_pillars.scans.scan_reader import read_scan
from asca_pillars.sim.simulation import load_simulation_config
from benchmarks.fuzz_recordings import read_recording, recording_seeds

LABEL = "Car 0.00 0 1.85 387.63 181.54 423.81 203.12 1.67 1.87 3.69 -16.53 2.39 58.49 1.57"
CALIBRATION = """P0: 721.5 0 609.6 0 0 721.5 172.9 0 0 0 1 0
P2: 721.5 0 609.6 44.9 0 721.5 172.9 0.2 0 0 1 0.003
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27
"""
BOX = {"class": "Car", "x_m": 9.5, "y_m": -2, "z_m": -0.9, "length_m": 4, "width_m": 1.8, "height_m": 1.6, "yaw_rad": 3}
METADATA = """rosbag2_bagfile_information:
  version: 5
  storage_identifier: sqlite3
  relative_file_paths: [bag_0.db3]
  topics_with_message_count:
    - topic_metadata: {name: /lidar, type: sensor_msgs/msg/PointCloud2, serialization_format: cdr}
      message_count: 3
  compression_format: ""
  compression_mode: ""
"""


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
    training = folder / "root" / "training"
    for name in ("velodyne", "label_2", "calib"):
        (training / name).mkdir(parents=True, exist_ok=True)
    for frame in ("000000", "000001"):
        (training / "velodyne" / f"{frame}.bin").write_bytes(bytes(16))
    (training / "label_2" / "000000.txt").write_text(LABEL + "\n")
    (training / "calib" / "000000.txt").write_text(CALIBRATION)
    (folder / "root" / "ImageSets").mkdir(exist_ok=True)
    calibration, truth = read_calibration(training / "calib" / "000000.txt"), read_truth(training / "label_2")
    plain = folder / "plain.yaml"
    plain.write_text("name: plain\n")

    def boxes(path: Path) -> Any:
        return boxes_from_objects(objects_3d(read_labels(path)), calibration)

    def predictions(path: Path) -> Any:
        return [frame.scores for frame in read_predictions(path.parent, truth, training / "label_2").detections]

    def calibrated(path: Path) -> Any:
        found = read_calibration(path)
        return [found.p2, found.r0_rect, found.camera_from_lidar]

    def override(path: Path) -> Any:
        return _numbers(load_config(plain, [path.read_text(encoding="utf-8", errors="replace")]))

    def simulation(path: Path) -> Any:
        return to_dict(load_simulation_config(str(path)))

    def image_set(path: Path) -> Any:
        return len(KittiSplit(path.parent.parent, path.stem).frame_ids)

    bundle = _bundle(folder / "bundle")
    labels = (f"{LABEL}\n{LABEL.replace('Car', 'DontCare')}\n".encode(), b"", LABEL.replace("0.00", "-1").encode())
    scored = (f"{LABEL} 0.9\n{LABEL} 0.1\n".encode(), b"")
    overrides = ("train.epochs=20", "model.spec.grid.x_range_m=[0, 61.44]", "augment.insert.proportions={Car: 1}")
    text = yaml.safe_dump(to_dict(Config()), sort_keys=False)
    configs = (b"name: x\naugment: {scale: [1, 2]}\n", *(p.read_bytes() for p in shipped_configs().values()))
    sections = [f"{key}:{part}".encode() for key, part in _sections(text)]
    simulations = tuple(path.read_bytes() for path in shipped_configs("simulation").values())
    scans = [
        Kind(f"scan .{suffix}", folder / f"scan.{suffix}", seeds, read_points, 4.0, is_scan=True)
        for suffix, seeds in scan_seeds().items()
    ]
    recordings = [
        Kind(f"recording .{suffix}", folder / f"drive.{suffix}", seeds, read_recording, 2.0)
        for suffix, seeds in recording_seeds().items()
    ]
    (folder / "bag").mkdir(exist_ok=True)
    (folder / "bag" / "bag_0.db3").write_bytes(recording_seeds()["db3"][0])
    box_files = [
        Kind(f"boxes .{suffix}", folder / f"boxes.{suffix}", seeds, reader)
        for suffix, seeds, reader in (
            ("json", (json.dumps({"time_s": 1.5, "boxes": [BOX, BOX]}).encode(),), frame_boxes),
            ("jsonl", (f"{json.dumps({'scan': 'a.bin', 'boxes': [BOX]})}\n".encode(),), named_boxes),
            ("csv", (f"scan,{','.join(BOX)}\na.bin,{','.join(map(str, BOX.values()))}\n".encode(),), named_boxes),
        )
    ]
    return [
        *scans,
        *recordings,
        *box_files,
        Kind("metadata.yaml", folder / "bag" / "metadata.yaml", (METADATA.encode(),), rosbag2, 0.5),
        Kind("pose", folder / "pose.txt", (b"1 0 0 0\n0 1 0 0\n0 0 1 1.7\n0 0 0 1\n",), read_pose, 0.5),
        Kind("config", folder / "config.yaml", (*configs, *sections), lambda path: _numbers(load_config(path)), 0.25),
        Kind("simulation", folder / "sim.yaml", simulations, simulation, 0.2),
        Kind("override", folder / "override.txt", tuple(word.encode() for word in overrides), override, 0.5),
        Kind("labels", folder / "labels.txt", labels, boxes, 2.0),
        Kind("calibration", folder / "calibration.txt", (CALIBRATION.encode(),), calibrated, 2.0),
        Kind("predictions", folder / "found" / "000000.txt", scored, predictions, 2.0),
        Kind("ImageSets", folder / "root" / "ImageSets" / "val.txt", (b"000000\n000001\n",), image_set, 2.0),
        Kind("manifest", bundle / "bundle.json", ((bundle / "bundle.json").read_bytes(),), _manifest, 0.2),
    ]


def frame_boxes(path: Path) -> Any:
    """Read the boxes and the time of a file of one frame."""
    return read_frame_file(path).boxes, read_time(path)


def named_boxes(path: Path) -> Any:
    """Read the boxes of a file of several frames."""
    return [frame.records.boxes for frame in read_frames(path)]


def rosbag2(path: Path) -> Any:
    """Read the scans of the folder of a metadata.yaml."""
    return read_recording(path.parent)


def read_points(path: Path) -> Any:
    """Read the points of a scan."""
    return read_scan(path).points


def scan_seeds() -> dict[str, tuple[bytes, ...]]:
    """Return small valid scans of each format and encoding, by suffix."""
    points = np.random.default_rng(0).uniform((-50, -50, -2, 0), (50, 50, 2, 1), (6, 4)).astype("<f4")
    rings = np.column_stack([points, [0, 1, 2, 3, 4, 5]]).astype("<f4")
    rows = "".join(" ".join(f"{value:.3f}" for value in point) + "\n" for point in points).encode()

    def pcd(encoding: str, body: bytes) -> bytes:
        head = "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 6\nHEIGHT 1\n"
        return f"{head}VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 6\nDATA {encoding}\n".encode() + body

    def ply(encoding: str, before: bytes, body: bytes) -> bytes:
        head = f"ply\nformat {encoding} 1.0\nelement strip 2\nproperty list uchar int items\nelement vertex 6\n"
        properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
        return f"{head}{properties}end_header\n".encode() + before + body

    def npy(array: np.ndarray) -> bytes:
        header = str({"descr": array.dtype.str, "fortran_order": False, "shape": array.shape}) + "\n"
        return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + array.tobytes()

    columns = points.T.tobytes()
    packed = b"".join(bytes([len(columns[i : i + 32]) - 1]) + columns[i : i + 32] for i in range(0, 96, 32))
    sizes = len(packed).to_bytes(4, "little") + len(columns).to_bytes(4, "little")
    lists = b"\x01\x00\x00\x00\x07\x00"
    return {
        "bin": (points.tobytes(), rings.tobytes()),
        "npy": (npy(points), npy(points.astype("f8")), npy((points * 100).astype("i2"))),
        "pcd": (pcd("ascii", rows), pcd("binary", points.tobytes()), pcd("binary_compressed", sizes + packed)),
        "ply": (
            ply("ascii", b"1 7\n0\n", rows),
            ply("binary_little_endian", lists, points.tobytes()),
            ply("binary_big_endian", b"\x01\x00\x00\x00\x07\x00", points.astype(">f4").tobytes()),
        ),
    }


def _bundle(folder: Path) -> Path:
    """Create a bundle of links to the shipped graphs, with a manifest that can be damaged."""
    folder.mkdir(exist_ok=True)
    for path in default_bundle_path().iterdir():
        if path.suffix == ".onnx" and not (folder / path.name).exists():
            (folder / path.name).symlink_to(path.resolve())
    manifest = json.loads((default_bundle_path() / "bundle.json").read_text(encoding="utf-8"))
    (folder / "bundle.json").write_text(json.dumps(manifest), encoding="utf-8")
    return folder


def _manifest(path: Path) -> Any:
    return to_dict(load_pillar_bundle(path.parent))


def _sections(text: str) -> list[tuple[str, str]]:
    """Return the top-level sections of a YAML text: smaller files are faster to read and more of them matters."""
    parts = ("\n" + text).split("\n")
    starts = [i for i, line in enumerate(parts) if line and not line.startswith((" ", "-"))]
    whole = ["\n".join(parts[a:b]) for a, b in zip(starts, [*starts[1:], len(parts)], strict=True)]
    return [(part.partition(":")[0], part.partition(":")[2]) for part in whole]


def _numbers(config: Config) -> Any:
    """Return the numbers of a config, and those of its grid."""
    spec = config.model.spec
    return to_dict(config), spec.anchors.shape[:2] if isinstance(spec, VoxelSpec) else (spec.grid.nx, spec.grid.ny)
