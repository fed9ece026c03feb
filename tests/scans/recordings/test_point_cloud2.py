"""PointCloud2 of any layout gives the points that were put into it."""

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings.point_cloud2 import PointCloud, read_point_cloud
from asca_pillars.scans.recordings.recording import Message
from benchmarks.made_recordings import point_cloud2
from tests.scans.recordings.cloud_recordings import CLOUD, START_NS, cloud_points, laid_out, store

POINTS = cloud_points(1, 24)
OUSTER = [
    ("x", "f4", 0),
    ("y", "f4", 4),
    ("z", "f4", 8),
    ("reflectivity", "u2", 20),
    ("ring", "u1", 24),
    ("t", "u4", 16),
]


def read(message: object, recorded_ns: int = 5) -> PointCloud:
    return read_point_cloud(Message(recorded_ns, bytes(store().serialize_cdr(message, CLOUD)), "cdr"), "here")


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize(("rows", "row_padding"), [(1, 0), (4, 0), (4, 7)])
@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_offsets_padding_and_byte_order(big_endian: bool, rows: int, row_padding: int, kind: str) -> None:
    layout = [("intensity", "f4", 0), ("z", kind, 29), ("y", kind, 12), ("x", kind, 40)]
    message = laid_out(
        POINTS[:, [3, 2, 1, 0]], layout=layout, step=51, rows=rows, row_padding=row_padding, big_endian=big_endian
    )
    cloud = read(message)
    assert np.array_equal(cloud.points.xyz, POINTS[:, :3])
    assert cloud.points.reflectance is not None and np.array_equal(cloud.points.reflectance, POINTS[:, 3])


def test_whole_numbers_as_drivers_write_them() -> None:
    columns = np.column_stack([POINTS[:, :3], np.arange(24) * 100, np.arange(24), np.arange(24)])
    cloud = read(laid_out(columns.astype(np.float32), layout=OUSTER, step=32))
    assert cloud.points.reflectance is not None and cloud.points.dtype is not None
    assert cloud.points.reflectance.tolist() == [100 * i for i in range(24)]
    assert cloud.points.dtype.kind == "u" and np.array_equal(cloud.points.xyz, POINTS[:, :3])


def test_without_a_reflectance() -> None:
    assert (
        read(laid_out(POINTS, layout=[("x", "f4", 0), ("y", "f4", 4), ("z", "f4", 8)], step=12)).points.reflectance
        is None
    )


def test_the_stamp_of_the_header_counts_and_the_recorded_time_where_there_is_none() -> None:
    assert read(laid_out(POINTS)).time_ns == START_NS
    assert read(laid_out(POINTS, time_ns=0), recorded_ns=77).time_ns == 77
    for known in (read(laid_out(POINTS)), read(laid_out(POINTS, time_ns=0), recorded_ns=0)):
        assert known.points.remarks == ()


def test_a_time_that_is_nowhere_is_zero_and_said() -> None:
    data = bytes(store().serialize_cdr(laid_out(POINTS, time_ns=0), CLOUD))
    cloud = read_point_cloud(Message(None, data, "cdr"), "here")
    assert cloud.time_ns == 0 and "time stamp" in cloud.points.remarks[0]


def test_no_points() -> None:
    assert len(read(laid_out(POINTS[:0])).points.xyz) == 0


def test_the_last_row_may_lack_its_padding() -> None:
    message = laid_out(POINTS, rows=4, row_padding=8)
    message.data = message.data[:-8]
    assert np.array_equal(read(message).points.xyz, POINTS[:, :3])
    message.data = message.data[:-1]
    with pytest.raises(ScanError, match=r"here: \d+ bytes where 4 x 6 points of 16 bytes in rows of 104"):
        read(message)


@pytest.mark.parametrize("row_step", [0, 1, 6, 16, 95, 97, 6 * 4 * 16, 2**32 - 1])
@pytest.mark.parametrize("ros1", [False, True])
def test_a_wrong_row_step_where_there_is_no_room_for_padding(row_step: int, ros1: bool) -> None:
    """Drivers write the whole cloud's bytes, its width, or nothing."""
    one = store(ros1)
    message = point_cloud2(one, START_NS, POINTS)
    message.height, message.width, message.row_step = 4, 6, row_step
    if ros1:
        cloud = read_point_cloud(Message(1, bytes(one.serialize_ros1(message, CLOUD)), "ros1"), "here")
    else:
        cloud = read(message)
    assert np.array_equal(cloud.points.xyz, POINTS[:, :3])


def test_ros1() -> None:
    one = store(ros1=True)
    data = bytes(one.serialize_ros1(point_cloud2(one, START_NS, POINTS), CLOUD))
    assert np.array_equal(read_point_cloud(Message(1, data, "ros1"), "here").points.xyz, POINTS[:, :3])


def test_contradictions_are_named() -> None:
    with pytest.raises(ScanError, match="no field z among x, y, ring"):
        read(laid_out(POINTS, layout=[("x", "f4", 0), ("y", "f4", 4), ("ring", "u2", 8)], step=12))
    message = laid_out(POINTS)
    message.fields[0].offset = 14
    with pytest.raises(ScanError, match="field x at byte 14 lies beyond the points' 16 bytes"):
        read(message)
    message = laid_out(POINTS)
    message.fields[1].datatype = 12
    with pytest.raises(ScanError, match="field y has datatype 12"):
        read(message)
    with pytest.raises(ScanError, match="no readable PointCloud2"):
        read_point_cloud(Message(1, b"torn", "cdr"), "here")
    message = laid_out(POINTS)
    message.height = message.width = 2**31 - 1
    with pytest.raises(ScanError, match="points are more than"):
        read(message)
