"""Import of Waymo's parquet form: a small segment in the published columns, made here from known points."""

from pathlib import Path

import numpy as np
import pytest

from asca_pillars.base.errors import DatasetError, OutputError
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.importing.waymo_parquet import read_waymo
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
        with pytest.raises(DatasetError, match=r"lidar_calibration/segment\.parquet: no readable parquet file"):
            read_waymo(source, tmp_path / "out")
    calibration.write_bytes((source / "lidar_box" / "segment.parquet").read_bytes())
    with pytest.raises(DatasetError, match=r"no column `key\.laser_name`"):
        read_waymo(source, tmp_path / "out")
