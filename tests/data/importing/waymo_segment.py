"""A small segment of Waymo's dataset in Parquet."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

TIMES = (1000, 2000)
HEIGHT, WIDTH = 4, 360
INCLINATIONS = np.radians([-12.0, -7.0, -4.0, -2.0])  # from the lowest up
EXTRINSIC_YAW, SENSOR_M = 0.6, np.array([1.4, 0.0, 2.0])
BOX = (10.0, 4.0, 1.0, 4.6, 1.9, 2.0, 0.3)


def extrinsic() -> np.ndarray:
    cos, sin = np.cos(EXTRINSIC_YAW), np.sin(EXTRINSIC_YAW)
    matrix = np.eye(4)
    matrix[:2, :2], matrix[:3, 3] = [[cos, -sin], [sin, cos]], SENSOR_M
    return matrix


def range_image(aim_m: np.ndarray) -> np.ndarray:
    """(H, W, 4): one return, of the pixel that looks nearest to a point of the vehicle's frame, at its distance."""
    image = np.zeros((HEIGHT, WIDTH, 4), np.float32)
    seen = extrinsic()[:3, :3].T @ (aim_m - SENSOR_M)
    distance = np.linalg.norm(seen)
    row = HEIGHT - 1 - np.abs(INCLINATIONS - np.arcsin(seen[2] / distance)).argmin()
    # The first column looks behind the vehicle and the next ones further to the right: azimuth pi falls to -pi.
    azimuth = np.arctan2(seen[1], seen[0]) + EXTRINSIC_YAW
    column = int((np.pi - azimuth) / (2 * np.pi) * WIDTH)
    image[row, column] = distance, 0.5, 0, -1
    return image


def write_segment(
    root: Path, *, moved_m: float = 0.0, further: Mapping[tuple[int, int], np.ndarray] | None = None
) -> Path:
    """One segment with a vehicle at BOX.

    Args:
        root: the folder.
        moved_m: every pixel was measured that much further back.
        further: images besides that of the vehicle, by sensor and return.
    """
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")

    def write(name: str, columns: dict[str, Any]) -> None:
        (root / name).mkdir(parents=True, exist_ok=True)
        parquet.write_table(pyarrow.table(columns), root / name / "segment.parquet")

    keys: dict[str, Any] = {}
    seen = {(1, 1): range_image(np.array([10.0 + moved_m, 4.0, 1.0])), **(further or {})}
    rows = [(time, laser) for time in TIMES for laser in (1, 2)]
    keys["key.frame_timestamp_micros"], keys["key.laser_name"] = map(list, zip(*rows, strict=True))
    images: dict[str, Any] = {}
    for number in (1, 2):
        own = [seen.get((laser, number)) for _, laser in rows]
        name = f"[LiDARComponent].range_image_return{number}"
        values = [None if image is None else image.ravel().tolist() for image in own]
        images[f"{name}.values"] = pyarrow.array(values, pyarrow.list_(pyarrow.float32()))
        shapes = [None if image is None else list(image.shape) for image in own]
        images[f"{name}.shape"] = pyarrow.array(shapes, pyarrow.list_(pyarrow.int32()))
    write("lidar", keys | images)
    box = ("center.x", "center.y", "center.z", "size.x", "size.y", "size.z", "heading")
    write(
        "lidar_box",
        {"key.frame_timestamp_micros": [1000], "key.laser_object_id": ["a"], "[LiDARBoxComponent].type": [1]}
        | {f"[LiDARBoxComponent].box.{name}": [value] for name, value in zip(box, BOX, strict=True)},
    )
    calibration = "[LiDARCalibrationComponent]"
    write(
        "lidar_calibration",
        {
            "key.laser_name": [1, 2],
            f"{calibration}.extrinsic.transform": [extrinsic().ravel().tolist()] * 2,
            f"{calibration}.beam_inclination.values": [INCLINATIONS.tolist(), None],
            f"{calibration}.beam_inclination.min": [-0.2, -0.2],
            f"{calibration}.beam_inclination.max": [0.0, 0.0],
        },
    )
    if moved_m:
        world = np.eye(4)
        world[:2, :2], world[:3, 3] = [[0, -1], [1, 0]], [100, 50, 3]  # the car drives along the world's y
        write(
            "vehicle_pose",
            {
                "key.frame_timestamp_micros": list(TIMES),
                "[VehiclePoseComponent].world_from_vehicle.transform": [world.ravel().tolist()] * 2,
            },
        )
        pose = np.zeros((HEIGHT, WIDTH, 6), np.float32)
        pose[..., 2:] = [np.pi / 2, 100, 50 - moved_m, 3]
        write(
            "lidar_pose",
            {
                "key.frame_timestamp_micros": list(TIMES),
                "key.laser_name": [1, 1],
                "[LiDARPoseComponent].range_image_return1.values": [pose.ravel().tolist()] * 2,
                "[LiDARPoseComponent].range_image_return1.shape": [list(pose.shape)] * 2,
            },
        )
    return root
