"""PointCloud2 of any layout gives the points that were put into it."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings.point_clouds import PointCloud, read_point_cloud
from asca_pillars.scans.recordings.recording import Message
from benchmarks.made_recordings import point_cloud2
from tests.scans.recordings.cloud_recordings import CLOUD, START_NS, cloud_points, laid_out, serialized, store

POINTS = cloud_points(1, 24)
XYZ = [("x", "f4", 0), ("y", "f4", 4), ("z", "f4", 8)]
OUSTER = [*XYZ, ("reflectivity", "u2", 20), ("ring", "u1", 24), ("t", "u4", 16)]


def read(message: Any, recorded_ns: int | None = 5, *, ros1: bool = False) -> PointCloud:
    data = message if isinstance(message, bytes) else serialized(message, CLOUD, ros1=ros1)
    return read_point_cloud(Message(recorded_ns, data, "ros1" if ros1 else "cdr"), "here")


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


def test_whole_numbers_clouds_without_a_reflectance_and_without_points() -> None:
    columns = np.column_stack([POINTS[:, :3], np.arange(24) * 100, np.arange(24), np.arange(24)])
    cloud = read(laid_out(columns.astype(np.float32), layout=OUSTER, step=32))
    assert cloud.points.reflectance is not None and cloud.points.dtype is not None
    assert cloud.points.reflectance.tolist() == [100 * i for i in range(24)]
    assert cloud.points.dtype.kind == "u" and np.array_equal(cloud.points.xyz, POINTS[:, :3])
    cloud = read(laid_out(POINTS, layout=XYZ, step=12))
    assert cloud.points.reflectance is None
    assert len(read(laid_out(POINTS[:0])).points.xyz) == 0


@pytest.mark.parametrize(
    ("stamp_ns", "recorded_ns", "expected"), [(START_NS, 5, START_NS), (0, 77, 77), (0, 0, 0), (0, None, 0)]
)
def test_the_stamp_of_the_header_counts_and_the_recorded_time_where_there_is_none(
    stamp_ns: int, recorded_ns: int | None, expected: int
) -> None:
    cloud = read(laid_out(POINTS, time_ns=stamp_ns), recorded_ns)
    assert cloud.time_ns == expected
    assert ["time stamp" in remark for remark in cloud.points.remarks] == [True] * (recorded_ns is None)


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
    message = point_cloud2(store(ros1), START_NS, POINTS)
    message.height, message.width, message.row_step = 4, 6, row_step
    assert np.array_equal(read(message, ros1=ros1).points.xyz, POINTS[:, :3])


def _enlarge(cloud: Any) -> None:
    cloud.height = cloud.width = 2**31 - 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda cloud: setattr(cloud.fields[2], "name", "ring"), "no field z among x, y, ring"),
        (lambda cloud: setattr(cloud.fields[0], "offset", 14), "field x at byte 14 lies beyond the points' 16 bytes"),
        (lambda cloud: setattr(cloud.fields[1], "datatype", 12), "field y has datatype 12"),
        (_enlarge, "points are more than"),
    ],
)
def test_contradictions_are_named(change: Callable[[Any], object], message: str) -> None:
    cloud = laid_out(POINTS)
    change(cloud)
    with pytest.raises(ScanError, match=message):
        read(cloud)
    with pytest.raises(ScanError, match="not a readable PointCloud2"):
        read(b"torn")
