"""Import of Waymo's parquet form: a small segment in the published columns, made here from known points.

Points of a range image, pixel by pixel with scipy's rotations.
"""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from asca_pillars.base.errors import DatasetError, OutputError
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.importing.waymo_parquet import LidarCalibration, range_image_points, read_waymo
from asca_pillars.geometry.boxes import points_in_boxes
from tests.data.importing.waymo_segment import BOX, SENSOR_M, WIDTH, range_image, write_segment
from tests.helpers.in_process import invoke


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
    source = write_segment(tmp_path / "waymo", further={(1, 2): behind, (2, 1): other})
    invoke("import", source, tmp_path / "out", "--from", "waymo")
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
    calibration = source / "lidar_calibration" / "segment.parquet"
    with pytest.raises(DatasetError, match=r"no lidar/\*\.parquet there"):
        read_waymo(tmp_path, tmp_path / "out")
    calibration.write_bytes(b"no parquet")
    for _ in range(2):  # the folder is marked as ours before anything else is read
        with pytest.raises(DatasetError, match=r"lidar_calibration/segment\.parquet: not a readable parquet file"):
            read_waymo(source, tmp_path / "out")
    calibration.write_bytes((source / "lidar_box" / "segment.parquet").read_bytes())
    with pytest.raises(DatasetError, match=r"no column `key\.laser_name`"):
        read_waymo(source, tmp_path / "out")


HEIGHT, COLUMNS = 3, 8
SENSOR, PLACE_M = Rotation.from_euler("xyz", [0.05, -0.1, 0.7]), np.array([1.4, 0.2, 2.0])
CAR, CAR_M = Rotation.from_euler("xyz", [-0.1, 0.2, 2.5]), np.array([100.0, -50.0, 3.0])


def placed(turn: Rotation, place_m: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn.as_matrix(), place_m
    return matrix


def drawn_image(rng: np.random.Generator) -> np.ndarray:
    """Every other pixel has a return."""
    image = rng.uniform(3, 40, (HEIGHT, COLUMNS, 4)).astype(np.float32)
    image[..., 0] *= np.arange(HEIGHT * COLUMNS).reshape(HEIGHT, COLUMNS) % 2
    return image


def seen(image: np.ndarray, upwards_rad: np.ndarray) -> list[tuple[int, int, np.ndarray]]:
    """Row, column and point in the vehicle's frame of each return; lasers from the lowest up."""
    turned = np.arctan2(SENSOR.as_matrix()[1, 0], SENSOR.as_matrix()[0, 0])
    found = []
    for row, column in np.argwhere(image[..., 0] > 0).tolist():
        # The first column looks straight behind the vehicle, the next ones go clockwise as seen from above.
        azimuth = np.pi - 2 * np.pi * (column + 0.5) / COLUMNS - turned
        ray = Rotation.from_euler("yz", [-upwards_rad[HEIGHT - 1 - row], azimuth]).apply([image[row, column, 0], 0, 0])
        found.append((row, column, SENSOR.apply(ray) + PLACE_M))
    return found


@pytest.mark.parametrize("even", [False, True])
def test_every_return_lies_on_its_beam(even: bool) -> None:
    """Waymo gives one sensor's beams one by one, and of the others the ends of a span that is cut into even parts."""
    low, high, image = -0.5, 0.1, drawn_image(np.random.default_rng(0))
    upwards = np.array([low + (number + 0.5) / HEIGHT * (high - low) for number in range(HEIGHT)])
    given = upwards if even else np.array([-0.45, -0.1, 0.05])
    calibration = LidarCalibration(placed(SENSOR, PLACE_M), None if even else given, low, high)
    points = range_image_points(image, calibration)
    assert len(points) == HEIGHT * COLUMNS // 2
    np.testing.assert_allclose(points[:, :3], [point for *_, point in seen(image, given)], atol=1e-5)


def test_a_car_that_leans_while_it_turns_is_taken_back_to_one_time() -> None:
    rng = np.random.default_rng(1)
    image, upwards = drawn_image(rng), np.array([-0.4, -0.1, 0.05])
    poses = np.concatenate(
        [rng.uniform(-0.5, 0.5, (HEIGHT, COLUMNS, 3)), rng.uniform(-9, 9, (HEIGHT, COLUMNS, 3))], axis=2
    )
    calibration = LidarCalibration(placed(SENSOR, PLACE_M), upwards, 0.0, 0.0)
    points = range_image_points(image, calibration, poses.astype(np.float32), placed(CAR, CAR_M))
    expected = []
    for row, column, point in seen(image, upwards):
        turn, place_m = Rotation.from_euler("xyz", poses[row, column, :3]), poses[row, column, 3:]
        expected.append(CAR.inv().apply(turn.apply(point) + place_m - CAR_M))
    np.testing.assert_allclose(points[:, :3], expected, atol=1e-4)
