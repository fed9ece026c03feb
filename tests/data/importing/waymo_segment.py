"""A small segment of Waymo's dataset in Parquet."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

TIME, LASER = "key.frame_timestamp_micros", "key.laser_name"
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

    def lists(values: Sequence[Any], kind: Any) -> Any:
        plain = [value if value is None else np.ravel(value).tolist() for value in values]
        return pyarrow.array(plain, pyarrow.list_(kind))

    seen = {(1, 1): range_image(np.array([10.0 + moved_m, 4.0, 1.0])), **(further or {})}
    rows = [(time, laser) for time in TIMES for laser in (1, 2)]
    columns: dict[str, Any] = {TIME: [time for time, _ in rows], LASER: [laser for _, laser in rows]}
    for number in (1, 2):
        own = [seen.get((laser, number)) for _, laser in rows]
        name = f"[LiDARComponent].range_image_return{number}"
        columns[f"{name}.values"] = lists(own, pyarrow.float32())
        columns[f"{name}.shape"] = lists([image if image is None else image.shape for image in own], pyarrow.int32())
    write("lidar", columns)
    box = ("center.x", "center.y", "center.z", "size.x", "size.y", "size.z", "heading")
    labels = {f"[LiDARBoxComponent].box.{name}": [value] for name, value in zip(box, BOX, strict=True)}
    write("lidar_box", {TIME: [1000], "key.laser_object_id": ["a"], "[LiDARBoxComponent].type": [1]} | labels)
    calibration = {
        "extrinsic.transform": [extrinsic().ravel().tolist()] * 2,
        "beam_inclination.values": [INCLINATIONS.tolist(), None],
        "beam_inclination.min": [-0.2, -0.2],
        "beam_inclination.max": [0.0, 0.0],
    }
    columns = {f"[LiDARCalibrationComponent].{name}": value for name, value in calibration.items()}
    write("lidar_calibration", {LASER: [1, 2]} | columns)
    if moved_m:
        world = np.eye(4)
        world[:2, :2], world[:3, 3] = [[0, -1], [1, 0]], [100, 50, 3]  # the car drives along the world's y
        vehicle = "[VehiclePoseComponent].world_from_vehicle.transform"
        write("vehicle_pose", {TIME: list(TIMES), vehicle: [world.ravel().tolist()] * 2})
        pose = np.zeros((HEIGHT, WIDTH, 6), np.float32)
        pose[..., 2:] = [np.pi / 2, 100, 50 - moved_m, 3]
        pixels = "[LiDARPoseComponent].range_image_return1"
        values = {f"{pixels}.values": [pose.ravel().tolist()] * 2, f"{pixels}.shape": [list(pose.shape)] * 2}
        write("lidar_pose", {TIME: list(TIMES), LASER: [1, 1]} | values)
    return root
