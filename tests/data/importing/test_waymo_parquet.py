"""Import of Waymo's parquet form: a small segment in the published columns, made here from known points."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asca_pillars.base.errors import DatasetError, OutputError
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.importing.waymo_parquet import read_waymo
from asca_pillars.geometry.boxes import points_in_boxes
from tests.in_process import invoke

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


@pytest.mark.parametrize("moved_m", [0.0, 1.5])
def test_points_lie_in_the_boxes(tmp_path: Path, moved_m: float) -> None:
    source = write_segment(tmp_path / "waymo", moved_m=moved_m)
    assert "boxes: Vehicle 1" in invoke("import", source, tmp_path / "out", "--from", "waymo", "--val-share", 0.5)
    split = BoxSplit(tmp_path / "out")
    assert split.frame_ids == ("segment/1000", "segment/2000") and split.mounting.sensor_height_m == 0
    np.testing.assert_allclose(split.to_sensor.points(SENSOR_M[None]), 0, atol=1e-6)
    boxes, types = split.labeled_boxes("segment/1000")
    assert types == ("Vehicle",) and boxes[0].tolist() == pytest.approx(BOX)
    points = split.points("segment/1000")
    assert len(points) == 1 and points_in_boxes(points, boxes).all()
    np.testing.assert_allclose(points[0, :2], [10, 4], atol=0.15)  # a pixel is 1 degree wide
    assert points[0, 3] == pytest.approx(np.tanh(0.5))


def test_all_sensors_and_both_returns_are_read(tmp_path: Path) -> None:
    behind = range_image(np.array([14.0, 5.6, 1.0]))  # what the beam met beyond the edge of the vehicle
    other = np.zeros((5, WIDTH, 4), np.float32)
    other[1, 100, :2] = 7.0, 0.2
    invoke(
        "import",
        write_segment(tmp_path / "waymo", further={(1, 2): behind, (2, 1): other}),
        tmp_path / "out",
        "--from",
        "waymo",
    )
    points = BoxSplit(tmp_path / "out").points("segment/1000")
    assert len(points) == 3
    np.testing.assert_allclose(points[:2, :2], np.array([[10, 4], [14, 5.6]]), atol=0.15)
    # The second sensor's five beams cut -0.2 to 0 into even parts, from the highest down: row 1 is the fourth of them.
    inclination, azimuth = -0.2 + 3.5 / 5 * 0.2, np.pi - (100 + 0.5) / WIDTH * 2 * np.pi
    ray = np.array([np.cos(inclination) * np.cos(azimuth), np.cos(inclination) * np.sin(azimuth), np.sin(inclination)])
    np.testing.assert_allclose(points[2, :3], 7 * ray + SENSOR_M, atol=1e-5)
    assert points[2, 3] == pytest.approx(np.tanh(0.2))


def test_an_import_goes_on_where_it_stopped(tmp_path: Path) -> None:
    source = write_segment(tmp_path / "waymo")
    scan = tmp_path / "out" / "scans" / "segment" / "1000.npy"
    invoke("import", source, tmp_path / "out", "--from", "waymo")
    first = scan.stat().st_mtime_ns
    (scan.parent / "2000.npy").unlink()
    invoke("import", source, tmp_path / "out", "--from", "waymo")
    assert scan.stat().st_mtime_ns == first and (scan.parent / "2000.npy").exists()


def test_a_dataset_that_was_written_by_hand_stays(tmp_path: Path) -> None:
    source = write_segment(tmp_path / "waymo")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "dataset.yaml").write_text("axes: y-forward\n")
    with pytest.raises(OutputError, match=r"dataset\.yaml: .* give another OUT"):
        read_waymo(source, tmp_path / "out")
    assert (tmp_path / "out" / "dataset.yaml").read_text() == "axes: y-forward\n"


def test_mistakes_are_named(tmp_path: Path) -> None:
    source = write_segment(tmp_path / "waymo")
    with pytest.raises(DatasetError, match=r"no lidar/\*\.parquet there"):
        read_waymo(tmp_path, tmp_path / "out")
    (source / "lidar_calibration" / "segment.parquet").write_bytes(b"no parquet")
    for _ in range(2):  # the folder is marked as ours before anything else is read
        with pytest.raises(DatasetError, match=r"lidar_calibration/segment\.parquet: no readable parquet file"):
            read_waymo(source, tmp_path / "out")
    (source / "lidar_calibration" / "segment.parquet").write_bytes(
        (source / "lidar_box" / "segment.parquet").read_bytes()
    )
    with pytest.raises(DatasetError, match=r"no column `key\.laser_name`"):
        read_waymo(source, tmp_path / "out")
