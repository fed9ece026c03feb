"""Small datasets in the layouts of their publishers."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation


def turned(roll: float, pitch: float, yaw: float) -> Rotation:
    return Rotation.from_euler("xyz", [roll, pitch, yaw])


def quaternion(turn: Rotation) -> list[float]:
    """w, x, y, z."""
    x, y, z, w = turn.as_quat().tolist()
    return [w, x, y, z]


TURN = quaternion(turned(0.2, -0.3, 0.7))


def write_argoverse2(root: Path, turn: Sequence[float] = TURN) -> Path:
    pyarrow, feather = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.feather")
    rng = np.random.default_rng(0)
    for log in ("log_a", "log_b"):
        lidar = root / "val" / log / "sensors" / "lidar"
        lidar.mkdir(parents=True)
        points = np.array([20.0, 5, 1]) + rng.uniform(-0.4, 0.4, (50, 3))
        columns = {name: points[:, axis].astype(np.float16) for axis, name in enumerate("xyz")}
        columns["intensity"] = rng.integers(0, 256, 50).astype(np.uint8)
        columns["laser_number"] = np.zeros(50, np.uint8)
        feather.write_feather(pyarrow.table(columns), lidar / "315966265259836000.feather")
        labels: dict[str, Any] = {"timestamp_ns": [315966265259836000, 315966265360032000], "track_uuid": ["u", "u"]}
        labels |= {"category": ["REGULAR_VEHICLE"] * 2, "num_interior_pts": [50, 50]}
        values = {"length_m": 4.0, "width_m": 2, "height_m": 1.6, "tx_m": 20, "ty_m": 5, "tz_m": 1}
        values |= dict(zip(("qw", "qx", "qy", "qz"), turn, strict=True))
        labels |= {name: [float(value)] * 2 for name, value in values.items()}
        feather.write_feather(pyarrow.table(labels), root / "val" / log / "annotations.feather")
    return root


# The car leans and drives uphill; nuScenes' LiDAR, a little askew, has its y axis ahead.
POSE, SENSOR = turned(0.06, -0.09, 0.4), turned(0.03, 0.05, -np.pi / 2)
WORLD_M, EGO_M, SENSOR_M = np.array([105.0, 52.0, 1.0]), np.array([100.0, 50.0, 0.0]), np.array([0.9, 0.0, 1.8])
CAR = turned(0.02, -0.04, 0.7)
ANNOTATION = ("token", "instance_token", "translation", "size", "rotation")


def in_sensor() -> tuple[np.ndarray, Rotation]:
    """Where the car stands in the sensor's frame, and how it is turned there."""
    center = SENSOR.inv().apply(POSE.inv().apply(WORLD_M - EGO_M) - SENSOR_M)
    return center, SENSOR.inv() * POSE.inv() * CAR


def write_nuscenes(root: Path) -> Path:
    """One key frame with a car full of points, and an animal."""
    points = in_sensor()[0] + np.random.default_rng(0).uniform(-0.3, 0.3, (30, 3))
    path = root / "samples" / "LIDAR_TOP" / "n__LIDAR_TOP__1.pcd.bin"
    path.parent.mkdir(parents=True)
    np.column_stack([points, np.full(30, 51.0), np.arange(30) % 32]).astype("<f4").tofile(path)
    tables: dict[str, list[dict[str, Any]]] = {
        "scene": [{"token": "sc", "name": "scene-0001"}],
        "sample": [{"token": "sa", "scene_token": "sc"}],
        "sensor": [{"token": "l", "channel": "LIDAR_TOP"}, {"token": "c", "channel": "CAM_FRONT"}],
        "calibrated_sensor": [
            {"token": "cl", "sensor_token": "l", "translation": SENSOR_M.tolist(), "rotation": quaternion(SENSOR)},
            {"token": "cc", "sensor_token": "c", "translation": [0, 0, 0], "rotation": [1, 0, 0, 0]},
        ],
        "ego_pose": [{"token": "e", "translation": EGO_M.tolist(), "rotation": quaternion(POSE)}],
        "category": [{"token": "k", "name": "vehicle.car"}, {"token": "a", "name": "animal"}],
        "instance": [{"token": "i", "category_token": "k"}, {"token": "j", "category_token": "a"}],
        "sample_annotation": [
            dict(zip(ANNOTATION, row, strict=True), sample_token="sa")
            for row in (
                ("1", "i", WORLD_M.tolist(), [2.0, 4.5, 1.6], quaternion(CAR)),
                ("2", "j", [90, 40, 0], [0.4, 1.0, 0.5], [1, 0, 0, 0]),
            )
        ],
    }
    data = {"sample_token": "sa", "ego_pose_token": "e", "is_key_frame": True}
    tables["sample_data"] = [
        {"token": "x", "calibrated_sensor_token": "cl", "filename": str(path.relative_to(root)), **data},
        {"token": "y", "calibrated_sensor_token": "cc", "filename": "samples/CAM_FRONT/1.jpg", **data},
        {"token": "z", "calibrated_sensor_token": "cl", "filename": "sweeps/2.bin", **data, "is_key_frame": False},
    ]
    (root / "v1.0-mini").mkdir()
    for name, rows in tables.items():
        (root / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    return root
