"""Clouds of Livox, of Foxglove and of the old sensor_msgs/PointCloud give the points that were put into them."""

import base64
import json
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

from rosbags.typesys import get_types_from_msg

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings.point_clouds import PointCloud, read_point_cloud
from asca_pillars.scans.recordings.recording import Encoding, Message, ScanKind, kind_of_scans
from tests.scans.recordings.cloud_recordings import START_NS, cloud_points, header, serialized, store

POINTS = cloud_points(3, 7)
LIVOX = "livox_ros_driver2/msg/CustomMsg"
LIVOX_TEXT = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\nCustomPoint[] points\n"
)
LIVOX_POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
# Two points, at x = 1 and turned by half: written by foxglove-schemas-protobuf 0.4.
PROTOBUF = bytes.fromhex(
    "0a060880e2cfaa0612056c696461721a160a0909000000000000f03f120919000000000000f03f25100000002a050a017818072a0a0a01791504"
    "00000018072a0a0a017a150800000018072a120a09696e74656e73697479150c000000180732200000803f00000040000040400000003f000080"
    "400000a0400000c0400000803e"
)


def read(data: bytes, kind: ScanKind, encoding: Encoding = "cdr") -> PointCloud:
    return read_point_cloud(Message(5, data, encoding), "here", kind)


def livox(ros1: bool, count: int, frame_id: str) -> bytes:
    one = store(ros1)
    one.register(get_types_from_msg(LIVOX_TEXT, LIVOX) | get_types_from_msg(LIVOX_POINT, f"{LIVOX[:-9]}CustomPoint"))
    point = one.types[f"{LIVOX[:-9]}CustomPoint"]
    points = [
        point(offset_time=i, x=x, y=y, z=z, reflectivity=10 * i, tag=9, line=3)
        for i, (x, y, z, _) in enumerate(POINTS[:count].tolist())
    ]
    message = one.types[LIVOX](
        header=header(one.types, START_NS, frame_id, ros1=ros1), timebase=7, point_num=count, lidar_id=1,
        rsvd=np.zeros(3, np.uint8), points=points,
    )  # fmt: skip
    return serialized(message, LIVOX, ros1=ros1, one=one)


@pytest.mark.parametrize("ros1", [False, True])
@pytest.mark.parametrize("frame_id", ["", "livox", "livox_frame", "lidar_of_x"])
@pytest.mark.parametrize("count", [0, 1, 7])
def test_livox(ros1: bool, frame_id: str, count: int) -> None:
    cloud = read(livox(ros1, count, frame_id), "Livox", "ros1" if ros1 else "cdr")
    assert np.array_equal(cloud.points.xyz, POINTS[:count, :3])
    assert cloud.points.reflectance is not None and cloud.points.dtype == np.uint8
    assert cloud.points.reflectance.tolist() == [10 * i for i in range(count)]
    assert (cloud.time_ns, cloud.frame_id) == (START_NS, frame_id)


@pytest.mark.parametrize("ros1", [False, True])
@pytest.mark.parametrize("channel", ["intensity", "Intensities", None])
def test_the_old_point_cloud(ros1: bool, channel: str | None) -> None:
    types, kind = store(ros1).types, "sensor_msgs/msg/PointCloud"
    point, values = types["geometry_msgs/msg/Point32"], types["sensor_msgs/msg/ChannelFloat32"]
    channels = [values(name="ring", values=np.zeros(7, np.float32))]
    channels += [values(name=channel, values=POINTS[:, 3].copy())] if channel else []
    points = [point(x=x, y=y, z=z) for x, y, z, _ in POINTS.tolist()]
    message = types[kind](header=header(types, START_NS, "lidar", ros1=ros1), points=points, channels=channels)
    cloud = read(serialized(message, kind, ros1=ros1), "PointCloud", "ros1" if ros1 else "cdr")
    assert np.array_equal(cloud.points.xyz, POINTS[:, :3]) and cloud.time_ns == START_NS
    assert (cloud.points.reflectance is None) == (channel is None)
    assert cloud.points.reflectance is None or np.array_equal(cloud.points.reflectance, POINTS[:, 3])


def foxglove_json(**changes: Any) -> bytes:
    fields = [{"name": name, "offset": 4 * i, "type": 7} for i, name in enumerate(("x", "y", "z", "intensity"))]
    content = {
        "timestamp": {"sec": START_NS // 10**9, "nsec": 5}, "frame_id": "lidar", "point_stride": 16, "fields": fields,
        "pose": {"position": {"x": 0, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}},
        "data": base64.b64encode(POINTS.astype("<f4").tobytes()).decode(),
    }  # fmt: skip
    return json.dumps(content | changes).encode()


def test_foxglove_in_json_and_in_protobuf_with_a_pose() -> None:
    cloud = read(foxglove_json(), "Foxglove", "json")
    assert np.array_equal(cloud.points.xyz, POINTS[:, :3]) and cloud.time_ns == START_NS + 5
    assert cloud.points.reflectance is not None and np.array_equal(cloud.points.reflectance, POINTS[:, 3])
    assert cloud.frame_id == "lidar"
    cloud = read(PROTOBUF, "Foxglove", "protobuf")
    assert cloud.points.xyz == pytest.approx(np.array([[0, -2, 3], [-3, -5, 6]]))
    assert cloud.points.reflectance is not None and cloud.points.reflectance.tolist() == [0.5, 0.25]
    assert (cloud.time_ns, cloud.frame_id) == (START_NS, "lidar")


@pytest.mark.parametrize("cut", [1, 20, 50])
def test_what_breaks_off_is_refused(cut: int) -> None:
    for data, kind, encoding in (
        (PROTOBUF, "Foxglove", "protobuf"),
        (foxglove_json(), "Foxglove", "json"),
        (livox(False, 7, "lidar"), "Livox", "cdr"),
        (livox(True, 7, "lidar"), "Livox", "ros1"),
    ):
        with pytest.raises(ScanError, match="here"):
            read(data[:-cut], kind, encoding)  # type: ignore[arg-type]


def test_types_that_are_read_and_a_claim_of_many_points() -> None:
    seven = (7).to_bytes(4, "little")  # the number of points, stated twice
    with pytest.raises(ScanError, match="need more"):
        read(livox(False, 7, "lidar").replace(seven, b"\xff\xff\xff\x7f"), "Livox")
    assert kind_of_scans("livox_ros_driver/CustomMsg") == kind_of_scans(LIVOX) == "Livox"
    assert kind_of_scans("foxglove.PointCloud") == "Foxglove"
    assert kind_of_scans("sensor_msgs/PointCloud") == "PointCloud"
    assert kind_of_scans("sensor_msgs/msg/LaserScan") is None


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"data": "###"}, "here"), ({"fields": [{"name": "x", "type": 0}]}, "here"), ({"point_stride": 0}, "beyond")],
)
def test_json_that_contradicts_itself(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ScanError, match=message):
        read(foxglove_json(**wrong), "Foxglove", "json")
