"""Packets of a Velodyne, packed after its manual, become whole revolutions; Ouster's real captures, where they are.

`ASCA_OUSTER_CAPTURES` names a folder of `.pcap` with `.json` beside.
"""

import os
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("velodyne_decoder", reason="needs pip install -e '.[packets]'")
pytest.importorskip("dpkt", reason="needs pip install -e '.[packets]'")
pytest.importorskip("ouster.sdk", reason="needs pip install -e '.[packets]'")

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings.messages import typestore
from asca_pillars.scans.recordings.packet_files import PacketCapture
from asca_pillars.scans.recordings.point_clouds import read_point_cloud
from asca_pillars.scans.recordings.recorded_scans import RecordedScan, RecordedScans, is_recording, open_recording
from asca_pillars.scans.recordings.recording import Encoding, Message, Recording, Topic, kind_of_scans

START_S = 1_700_000_000
CAPTURES = os.environ.get("ASCA_OUSTER_CAPTURES")
CAPTURES_THERE = sorted(Path(CAPTURES).glob("O*.pcap")) if CAPTURES else []


def udp_packet(payload: bytes) -> bytes:
    udp = struct.pack(">HHHH", 2368, 2368, 8 + len(payload), 0) + payload
    ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0, bytes(4), bytes(4)) + udp
    return bytes(12) + b"\x08\x00" + ip


def capture(path: Path, payloads: list[bytes], step_s: float = 0.001327) -> Path:
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1))
        for number, payload in enumerate(payloads):
            time_s, packet = START_S + number * step_s, udp_packet(payload)
            file.write(struct.pack("<IIII", int(time_s), round(time_s % 1 * 1e6), len(packet), len(packet)) + packet)
    return path


def vlp16_packets(revolutions: float, distance_m: float, reflectivity: int) -> list[bytes]:
    """Packets of a VLP-16 at 10 Hz, strongest return, all of whose returns come from one distance."""
    count = round(revolutions * 75.4)
    packets, azimuth = [], 0.0
    for number in range(count):
        blocks = b""
        for _ in range(12):
            channel = struct.pack("<HB", round(distance_m / 0.002), reflectivity)
            blocks += struct.pack("<HH", 0xEEFF, round(azimuth) % 36000) + 32 * channel
            azimuth += 39.8
        packets.append(blocks + struct.pack("<IBB", round(number * 1327.1), 0x37, 0x22))
    return packets


def scans_of(path: Path) -> list[RecordedScan]:
    recording = open_recording(path)
    return list(RecordedScans(recording, recording.point_cloud_topic(), "auto").read())


def test_velodynes_are_cut_by_revolution_and_ousters_need_metadata(tmp_path: Path) -> None:
    path = capture(tmp_path / "drive.pcap", [b"other", *vlp16_packets(3, 10.0, 51)])
    assert is_recording(path)
    scans = scans_of(path)
    assert 3 <= len(scans) <= 4
    times = [one.time_ns / 1e9 for one in scans]
    assert np.diff(times[:3]) == pytest.approx(0.1, abs=0.01) and times[0] == pytest.approx(START_S, abs=0.01)
    whole = scans[1].scan
    assert whole is not None and len(whole.points) == pytest.approx(28_900, rel=0.05)
    x, y, z, reflectance = whole.points.T
    assert np.sqrt(x**2 + y**2 + z**2) == pytest.approx(10, abs=0.2)
    assert np.degrees(np.arcsin(z / 10)).max() == pytest.approx(15, abs=0.6)
    assert reflectance == pytest.approx(0.2)
    directions = np.histogram(np.arctan2(y, x), bins=12)[0]
    assert directions.min() > 0.8 * directions.mean()
    path = capture(tmp_path / "drive.pcap", vlp16_packets(3, 10.0, 51))
    complete = scans_of(path)
    path.write_bytes(path.read_bytes()[: -path.stat().st_size // 3])
    torn = scans_of(path)
    assert 2 <= len(torn) < len(complete)
    first, same = torn[0].scan, complete[0].scan
    assert first is not None and same is not None and np.array_equal(first.points, same.points)
    with pytest.raises(ScanError, match=r"drive\.json"):
        open_recording(capture(tmp_path / "drive.pcap", [b"12345"]))


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_packets_of_a_velodyne_in_a_recording(encoding: Encoding) -> None:
    """velodyne_msgs/VelodyneScan: the same points as of a capture of these packets."""
    types = typestore(encoding)
    stamp = types.types["builtin_interfaces/msg/Time"]
    head = {"seq": 0} if encoding == "ros1" else {}
    header = types.types["std_msgs/msg/Header"](stamp=stamp(sec=START_S, nanosec=7), frame_id="velodyne", **head)
    one = types.types["velodyne_msgs/msg/VelodynePacket"]
    payloads = vlp16_packets(1, 10.0, 51)
    packets = [
        one(stamp=stamp(sec=START_S, nanosec=number * 1_327_000), data=np.frombuffer(payload, np.uint8))
        for number, payload in enumerate(payloads)
    ]
    scan = types.types["velodyne_msgs/msg/VelodyneScan"](header=header, packets=packets)
    write = types.serialize_ros1 if encoding == "ros1" else types.serialize_cdr
    data = bytes(write(scan, "velodyne_msgs/msg/VelodyneScan"))
    kind = kind_of_scans("velodyne_msgs/msg/VelodyneScan")
    assert kind == "Velodyne" == kind_of_scans("velodyne_msgs/VelodyneScan")
    cloud = read_point_cloud(Message(1, data, encoding), "a", kind)
    assert (cloud.frame_id, cloud.time_ns) == ("velodyne", START_S * 10**9 + 7)
    assert cloud.points.reflectance is not None and len(cloud.points.xyz) == pytest.approx(28_900, rel=0.02)
    assert np.linalg.norm(cloud.points.xyz, axis=1) == pytest.approx(10, abs=0.2)
    assert cloud.points.reflectance == pytest.approx(0.2)
    with pytest.raises(ScanError, match="not a readable point cloud of Velodyne"):
        read_point_cloud(Message(1, data[: len(data) // 2], encoding), "a", kind)
    empty = types.types["velodyne_msgs/msg/VelodyneScan"](header=header, packets=[])
    data = bytes(write(empty, "velodyne_msgs/msg/VelodyneScan"))
    assert len(read_point_cloud(Message(1, data, encoding), "a", kind).points.xyz) == 0


@pytest.mark.parametrize("content", [b"no capture", b""])
def test_no_capture(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "drive.pcap").write_bytes(content)
    with pytest.raises(ScanError, match=r"drive\.pcap"):
        open_recording(tmp_path / "drive.pcap")


@pytest.mark.skipif(not CAPTURES_THERE, reason="needs real captures: ASCA_OUSTER_CAPTURES")
@pytest.mark.parametrize("path", CAPTURES_THERE, ids=lambda path: path.stem)
def test_real_captures_of_an_ouster_are_what_its_library_says(path: Path) -> None:
    from ouster.sdk import core, open_source

    source = open_source(str(path))
    expected = []
    for scan in (one for both in source for one in both if one is not None):
        xyz = core.XYZLut(source.sensor_info[0], use_extrinsics=False)(scan)
        expected.append(xyz[scan.field("RANGE") > 0].astype(np.float32))
    scans = scans_of(path)
    assert len(scans) == len(expected) >= 1
    for one, xyz in zip(scans, expected, strict=True):
        assert one.scan is not None and np.array_equal(one.scan.points[:, :3], xyz)
        assert one.scan.points[:, 3].min() >= 0 and one.scan.points[:, 3].max() == 1.0
        assert one.time_ns > 1_600_000_000 * 10**9


class PacketRecording(Recording):
    """A recording of an Ouster's packets, as its driver publishes them."""

    def __init__(self, metadata: str | None, packets: list[tuple[int, bytes]]) -> None:
        self.path = Path("drive.mcap")
        self.topics = [Topic("/ouster/lidar_packets", "ouster_sensor_msgs/msg/PacketMsg", len(packets))]
        self._types, self._metadata, self._packets = typestore("cdr"), metadata, packets
        if metadata is not None:
            self.topics.append(Topic("/ouster/metadata", "std_msgs/msg/String", 1))

    def messages(self, topic: str) -> Iterator[Message]:
        if topic == "/ouster/metadata":
            yield self._message(1, "std_msgs/msg/String", data=self._metadata)
            return
        for time_ns, payload in self._packets:
            buf = np.frombuffer(payload + b"\0", np.uint8)
            yield self._message(time_ns, "ouster_sensor_msgs/msg/PacketMsg", buf=buf)

    def _message(self, time_ns: int, kind: str, **values: object) -> Message:
        return Message(time_ns, bytes(self._types.serialize_cdr(self._types.types[kind](**values), kind)), "cdr")


@pytest.mark.parametrize(("metadata", "message"), [(None, "no metadata of the Ouster"), ("{}", "unreadable metadata")])
def test_packets_of_an_ouster_in_a_recording_need_its_metadata(metadata: str | None, message: str) -> None:
    recording = PacketRecording(metadata, [])
    with pytest.raises(ScanError, match=f"/ouster/metadata: {message}"):
        RecordedScans(recording, recording.point_cloud_topic(), "auto")


@pytest.mark.skipif(not CAPTURES_THERE, reason="needs real captures: ASCA_OUSTER_CAPTURES")
@pytest.mark.parametrize("path", CAPTURES_THERE, ids=lambda path: path.stem)
def test_packets_of_an_ouster_in_a_recording_are_those_of_the_capture(path: Path) -> None:
    beside = [one for one in path.parent.glob("*.json") if path.stem.startswith(one.stem)]
    payloads = list(PacketCapture(path)._payloads())
    longest = max(len(payload) for _, payload in payloads)  # the others are of its IMU, on another topic
    packets = [(round(time_s * 1e9), payload) for time_s, payload in payloads if len(payload) == longest]
    recording = PacketRecording(beside[0].read_text(), packets)
    scans = RecordedScans(recording, recording.point_cloud_topic(), "auto")
    found, expected = list(scans.read()), scans_of(path)
    assert len(found) == len(expected) == scans.topic.messages
    for one, same in zip(found, expected, strict=True):
        assert one.scan is not None and same.scan is not None and one.frame_id == "os_sensor"
        assert np.array_equal(one.scan.points, same.scan.points)
        assert one.time_ns == pytest.approx(same.time_ns, abs=1000)
