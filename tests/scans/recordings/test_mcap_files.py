"""MCAP files as other writers leave them, damaged ones, and decompression bombs."""

import contextlib
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

import lz4.frame
from mcap.writer import CompressionType, IndexType

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings import mcap_files, messages
from asca_pillars.scans.recordings.recorded_scans import RecordedScans, open_recording
from asca_pillars.scans.recordings.recording import Recording, Topic
from tests.scans.recordings.cloud_recordings import (
    CLOUD,
    START_NS,
    clouds,
    read_scans,
    serialized,
    stamps,
    store,
    write_mcap,
)
from tests.scans.recordings.decompression_bombs import zstd_zeros

WRITERS: dict[str, dict[str, Any]] = {
    "all": {},
    "no channels in the summary": {"repeat_channels": False},
    "no schemas in the summary": {"repeat_schemas": False},
    "neither": {"repeat_channels": False, "repeat_schemas": False},
    "no statistics": {"use_statistics": False},
    "no indexes": {"index_types": IndexType.NONE},
    "no message indexes": {"index_types": IndexType.CHUNK},
    "no chunks": {"use_chunking": False},
    "no summary offsets": {"use_summary_offsets": False},
    "no checksums": {"enable_crcs": False},
    "checksum of all data": {"enable_data_crcs": True},
    "lz4": {"compression": CompressionType.LZ4},
    "not compressed": {"compression": CompressionType.NONE},
    "one chunk": {"chunk_size": 10**6},
}


def times(recording: Recording, topic: str = "/lidar") -> list[int | None]:
    return [one.recorded_ns for one in recording.messages(topic)]


@pytest.mark.parametrize("name", WRITERS)
def test_files_of_any_writer(tmp_path: Path, name: str) -> None:
    path = write_mcap(tmp_path / "a.mcap", {"/lidar": clouds(8), "/rear": clouds(2)}, **WRITERS[name])
    recording = open_recording(path)
    assert recording.topics == [Topic("/lidar", CLOUD, 8), Topic("/rear", CLOUD, 2)]
    assert times(recording) == stamps(8) and recording.damage is None
    assert [one.time_ns for one in read_scans(path, "/rear")] == stamps(2)


def test_messages_of_chunks_that_overlap_come_by_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    everything = clouds(12)
    mixed = [everything[index] for index in (3, 0, 7, 1, 2, 9, 4, 11, 5, 6, 8, 10)]
    recording = open_recording(write_mcap(tmp_path / "a.mcap", {"/lidar": mixed}))
    assert times(recording) == stamps(12)
    monkeypatch.setattr(mcap_files, "_MAX_OPEN_BYTES", 1)
    assert sorted(map(int, filter(None, times(recording)))) == stamps(12), "none is lost where memory is not enough"


def test_messages_of_one_time_come_in_the_order_of_the_file(tmp_path: Path) -> None:
    """As the library reads them, whether in one chunk or in several."""
    messages = [(START_NS + number % 3, bytes([number]) * 1500) for number in range(60)]
    for chunk_size in (1000, 4000, 10**6):  # one message in each, three, or all in one
        recording = open_recording(write_mcap(tmp_path / "a.mcap", {"/lidar": messages}, chunk_size=chunk_size))
        found = [one.data[0] for one in recording.messages("/lidar")]
        assert found == sorted(range(60), key=lambda number: number % 3)


def test_a_topic_without_a_schema_can_be_named(tmp_path: Path) -> None:
    """As early versions of rosbag2's plugin wrote it; it may hold something else."""
    note = serialized(store().types["std_msgs/msg/String"](data="no points"), "std_msgs/msg/String")
    path = write_mcap(tmp_path / "a.mcap", {"/lidar": clouds(2), "/note": [(5, note)]}, has_schema=False)
    with pytest.raises(ScanError, match=r"/lidar \(unknown, 2\), .* if .* name it \(--topic /lidar\)"):
        open_recording(path).point_cloud_topic()
    scans = read_scans(path, "/lidar")
    assert [one.time_ns for one in scans] == stamps(2) and all(one.scan is not None for one in scans)
    (one,) = read_scans(path, "/note")
    assert one.scan is None and "not a readable PointCloud2" in str(one.error_text)


@pytest.mark.parametrize(
    ("kind", "remedy"),
    [
        ("foxglove_msgs/msg/PointCloud", "record the PointCloud2"),
        *((kind, "driver") for kind in ("pandar_msgs/PandarScan", "rslidar_msg/msg/RslidarPacket")),
        ("nebula_msgs/msg/NebulaPackets", "driver"),
        *((kind, "record the scans, too") for kind in ("sensor_msgs/msg/LaserScan", "radar_msgs/msg/RadarScan")),
        ("std_msgs/msg/String", "record the scans, too"),
    ],
)
def test_topics_of_another_type_have_their_own_remedy(tmp_path: Path, kind: str, remedy: str) -> None:
    recording = open_recording(write_mcap(tmp_path / "a.mcap", {}, others={"/scans": kind}))
    for topic in (None, "/scans"):
        with pytest.raises(ScanError, match=rf"{kind}.*{remedy}"):
            recording.point_cloud_topic(topic)


@pytest.mark.parametrize("time_ns", [2**63, 2**64 - 1])
def test_times_that_no_clock_shows_are_none(tmp_path: Path, time_ns: int) -> None:
    message = clouds(1)[0][1]
    message.header.stamp.sec = message.header.stamp.nanosec = 0
    scans = read_scans(write_mcap(tmp_path / "a.mcap", {"/lidar": [(time_ns, message), (5, message)]}))
    assert [one.time_ns for one in scans] == [5, 0]
    remarks = [one.scan.notes.remarks for one in scans if one.scan is not None]
    assert remarks[0] == () and "time stamp" in remarks[1][0]


# --- decompression bombs


MAGIC = b"\x89MCAP0\r\n"


def with_chunk(data: bytes, *, compression: str, size: int, crc: int = 0) -> bytes:
    """A file of one chunk and no summary."""
    name = compression.encode()
    body = struct.pack("<QQQII", 0, 1, size, crc, len(name)) + name + struct.pack("<Q", len(data)) + data
    return MAGIC + record(1, bytes(8)) + record(6, body) + record(15, bytes(4)) + footer(0)


def footer(summary_start: int) -> bytes:
    return record(2, struct.pack("<QQI", summary_start, 0, 0)) + MAGIC


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def channel(number: int = 1) -> bytes:
    names = (b"/lidar", b"cdr")
    return record(4, struct.pack("<HH", number, 0) + b"".join(struct.pack("<I", len(n)) + n for n in names) + bytes(4))


LZ4_ZEROS = lz4.frame.compress(bytes(2**24))


@pytest.mark.parametrize(
    ("compression", "data", "size"),
    {
        "stated": ("zstd", zstd_zeros(2**33, stated=True), 2**33),
        "not stated by the chunk": ("zstd", zstd_zeros(2**33, stated=True), 100),
        "not stated by the frame": ("zstd", zstd_zeros(2**33, stated=False), 2**33),
        "stated by nobody": ("zstd", zstd_zeros(2**33, stated=False), 100),
        "just too much": ("zstd", zstd_zeros(2**28, stated=True), 2**28),
        **{f"lz4, {size}": ("lz4", LZ4_ZEROS, size) for size in (100, 2**24 + 1, 2**40)},
    }.values(),
)
def test_chunks_are_unpacked_to_no_more_than_is_stated(
    tmp_path: Path, compression: str, data: bytes, size: int
) -> None:
    (tmp_path / "a.mcap").write_bytes(with_chunk(data, compression=compression, size=size))
    said = r"1 of its chunks are damaged \(.*(stated?|full frame)\b.*copy or record it again"
    with pytest.raises(ScanError, match=said):
        open_recording(tmp_path / "a.mcap").point_cloud_topic()


MESSAGE = record(5, struct.pack("<HIQQ", 1, 0, 7, 7) + b"data")


@pytest.mark.parametrize(
    "filling",
    [bytes(10**7), record(0x90, b"") * 10**5, channel() * 10**5, record(5, struct.pack("<HIQQ", 9, 0, 0, 0)) * 10**5],
    ids=["zeros", "private records", "channels", "messages of no channel"],
)
def test_what_fills_a_chunk_hides_no_message(tmp_path: Path, filling: bytes) -> None:
    content = channel() + MESSAGE + filling
    whole = with_chunk(content, compression="", size=len(content), crc=zlib.crc32(content))
    (tmp_path / "a.mcap").write_bytes(whole)
    assert [one.data for one in open_recording(tmp_path / "a.mcap").messages("/lidar")] == [b"data"]


def test_chunks_within_the_summary_are_not_decompressed(tmp_path: Path) -> None:
    """The library would unpack the chunks there as if they belonged to the summary."""
    content = with_chunk(zstd_zeros(2**33, stated=True), compression="zstd", size=2**33)
    (tmp_path / "a.mcap").write_bytes(content.removesuffix(footer(0)) + footer(8))
    with pytest.raises(ScanError, match="1 of its chunks are damaged"):
        open_recording(tmp_path / "a.mcap").point_cloud_topic()


def test_a_large_chunk_that_is_large_packed_too_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(messages, "MAX_BYTES", 100)
    for compression in (CompressionType.ZSTD, CompressionType.LZ4):
        path = write_mcap(tmp_path / "a.mcap", {"/lidar": clouds(8)}, chunk_size=10**6, compression=compression)
        assert times(open_recording(path)) == stamps(8)


# --- damage


def test_a_message_that_breaks_off_does_not_lose_those_before(tmp_path: Path) -> None:
    content = channel() + MESSAGE + MESSAGE[:-1]
    (tmp_path / "a.mcap").write_bytes(with_chunk(content, compression="", size=len(content)))
    recording = open_recording(tmp_path / "a.mcap")
    assert len(list(recording.messages("/lidar"))) == 1 and "breaks off" in str(recording.damage)


@pytest.mark.parametrize("name", ["all", "no statistics", "lz4", "no chunks"])
def test_damage_anywhere_is_said(tmp_path: Path, name: str) -> None:
    whole = write_mcap(tmp_path / "a.mcap", {"/lidar": clouds(8, 20)}, **WRITERS[name]).read_bytes()
    rng = np.random.default_rng(3)
    for place in rng.integers(30, len(whole), 30).tolist():
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        (tmp_path / "b.mcap").write_bytes(damaged)
        with contextlib.suppress(ScanError):
            recording = open_recording(tmp_path / "b.mcap")
            scans = list(RecordedScans(recording, recording.point_cloud_topic("/lidar"), 1.0).read())
            lost = recording.damage is not None or any(one.scan is None for one in scans)
            assert lost or len(scans) == 8, place
