"""Compressed messages, chunks and files, decompression bombs, and files of rosbag2 without their folder."""

import bz2
import gc
import gzip
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs pip install -e '.[recordings]'")

import lz4.frame
import zstandard
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.recordings import messages
from asca_pillars.scans.recordings.messages import decompress_bz2, decompress_lz4, decompress_zstd
from asca_pillars.scans.recordings.recorded_scans import RecordedScans, is_recording, open_recording
from asca_pillars.scans.scan_settings import ScanSettings
from benchmarks.made_recordings import point_cloud2
from tests.scans.recordings.cloud_recordings import (
    CLOUD,
    cloud_points,
    clouds,
    laid_out,
    read_scans,
    serialized,
    stamps,
    store,
    write_mcap,
)
from tests.scans.recordings.decompression_bombs import zstd_zeros

DATA = np.random.default_rng(0).integers(0, 9, 300_000, np.uint8).tobytes()


def unsized(data: bytes) -> bytes:
    """A frame of zstd that does not state its size."""
    packer = zstandard.ZstdCompressor().compressobj()
    return packer.compress(data) + packer.flush()


ZSTD, UNSIZED, LZ4, BZ2 = zstandard.compress(DATA), unsized(DATA), lz4.frame.compress(DATA), bz2.compress(DATA)


def test_what_was_packed_comes_back_and_torn_streams_are_errors() -> None:
    for unpack, packed in ((decompress_zstd, ZSTD), (decompress_zstd, UNSIZED), (decompress_lz4, LZ4)):
        assert unpack(packed) == unpack(packed, len(DATA)) == DATA
    assert decompress_bz2(BZ2) == DATA
    torn: tuple[tuple[Callable[[bytes], bytes], bytes], ...]
    torn = (decompress_lz4, LZ4), (decompress_bz2, BZ2), (decompress_zstd, ZSTD)
    for read, whole in torn:
        with pytest.raises((ValueError, zstandard.ZstdError), match=r"end is missing|decompress"):
            read(whole[:-8])


@pytest.mark.parametrize("size", [len(DATA) - 1, len(DATA) + 1, 0, 2**40])
@pytest.mark.parametrize(
    ("unpack", "packed"),
    [(decompress_zstd, ZSTD), (decompress_zstd, UNSIZED), (decompress_lz4, LZ4)],
    ids=["zstd", "unsized zstd", "lz4"],
)
def test_another_size_than_the_stated_one_is_an_error(
    unpack: Callable[[bytes, int], bytes], packed: bytes, size: int
) -> None:
    with pytest.raises((ValueError, zstandard.ZstdError)):
        unpack(packed, size)


@pytest.mark.parametrize(
    ("unpack", "bomb"),
    [
        (decompress_zstd, zstd_zeros(2**33, stated=True)),
        (decompress_zstd, zstd_zeros(2**33, stated=False)),
        (decompress_lz4, lz4.frame.compress(bytes(2**24))),
        (decompress_bz2, bz2.compress(bytes(2**24))),
    ],
    ids=["zstd", "unsized zstd", "lz4", "bz2"],
)
def test_decompression_bombs_are_stopped_at_the_limit(
    unpack: Callable[[bytes], bytes], bomb: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(messages, "MAX_BYTES", 2**20)
    with pytest.raises(ValueError, match=r"\d+ bytes (state that they )?unpack to"):
        unpack(bomb)


# --- rosbag2


def rosbag2(folder: Path, storage: str, mode: str) -> Path:
    writer = Writer2(folder, version=9, storage_plugin=StoragePlugin[storage])
    if mode != "NONE":
        writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/lidar", CLOUD, typestore=store())
        for time_ns, message in clouds(3):
            writer.write(connection, time_ns, serialized(message, CLOUD))
    return folder


def times(path: Path) -> list[int]:
    """Return the times of the scans, all of which can be read."""
    scans = read_scans(path)
    assert is_recording(path) and all(one.scan is not None for one in scans)
    return [one.time_ns for one in scans]


@pytest.mark.parametrize("storage", ["MCAP", "SQLITE3"])
@pytest.mark.parametrize("mode", ["MESSAGE", "FILE", "NONE"])
def test_files_without_their_folder(tmp_path: Path, storage: str, mode: str) -> None:
    folder = rosbag2(tmp_path / "bag", storage, mode)
    (file,) = (path for path in folder.iterdir() if path.name != "metadata.yaml")
    assert times(folder) == times(file) == stamps(3)
    (folder / "metadata.yaml").unlink()
    assert times(folder) == times(file) == stamps(3)
    file.rename(moved := tmp_path / f"OTHER #1?%20{file.name[3:].upper()}")  # no address, a name
    assert times(moved) == stamps(3)


def test_what_the_user_unpacked_is_read_instead(tmp_path: Path) -> None:
    folder = rosbag2(tmp_path / "bag", "SQLITE3", "FILE")
    packed = folder / "bag.db3.zstd"
    (folder / "bag.db3").write_bytes(decompress_zstd(packed.read_bytes()))
    packed.write_bytes(b"no longer needed")
    assert len(times(folder)) == 3 and open_recording(folder).notes == ()
    packed.unlink()
    assert len(times(folder)) == 3


PACK = {
    ".zst": zstandard.compress,
    ".zstd": zstandard.compress,
    ".bz2": bz2.compress,
    ".gz": gzip.compress,
    ".lz4": lz4.frame.compress,
}


@pytest.mark.parametrize("suffix", [*(f".mcap{suffix}" for suffix in (*PACK, ".ZST", ".GZ")), ".BAG.gz"])
def test_files_that_were_packed_afterwards(tmp_path: Path, suffix: str) -> None:
    if suffix.startswith(".mcap"):
        plain = write_mcap(tmp_path / "a.mcap", {"/lidar": clouds(3)})
    else:
        plain = rosbag1(tmp_path / "a.bag", Writer1.CompressionFormat.LZ4)
    packed = tmp_path / f"b{suffix}"
    data, pack = plain.read_bytes(), PACK[packed.suffix.lower()]
    packed.write_bytes(pack(data[:1000]) + pack(data[1000:]))  # in two frames, as of programs that pack in parallel
    assert times(packed) == stamps(3)


@pytest.mark.parametrize("suffix", PACK)
def test_files_with_damage(tmp_path: Path, suffix: str) -> None:
    """What lies before it is read; what is not packed at all is refused."""
    noise = np.random.default_rng(0)
    messages = [(time_ns, laid_out(noise.random((5000, 4), np.float32), time_ns=time_ns)) for time_ns in stamps(40)]
    packed = PACK[suffix](write_mcap(tmp_path / "a.mcap", {"/lidar": messages}, use_chunking=False).read_bytes())
    path, half = tmp_path / f"b.mcap{suffix}", len(packed) // 2
    for damaged in (packed[:half], packed[:half] + bytes(half)):
        path.write_bytes(damaged)
        recording = open_recording(path)
        # bzip2's blocks have 0.9 MB, a frame of LZ4 at most 4.
        assert 5 <= sum(1 for _ in recording.messages("/lidar")) < 40
        assert str(recording.damage).startswith(f"{path}: ends early")
    path.write_bytes(b"not packed")
    with pytest.raises(ScanError, match=rf"b\.mcap{suffix}: not a readable {suffix} file .*; copy or record it again$"):
        open_recording(path)


def test_a_packing_that_is_not_read_is_named(tmp_path: Path) -> None:
    folder = rosbag2(tmp_path / "bag", "MCAP", "FILE")
    (folder / "bag.mcap.zstd").rename(folder / "bag.mcap.brotli")
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("bag.mcap.zstd", "bag.mcap.brotli"))
    with pytest.raises(ScanError, match=r"bag: bag\.mcap\.brotli is packed, and \.zstd, .* are read; unpack it"):
        open_recording(folder)


def test_copies_are_said_and_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    plain = write_mcap(tmp_path / "a.mcap", {"/lidar": clouds(3)})
    (tmp_path / "a.mcap.zst").write_bytes(zstandard.compress(plain.read_bytes()))
    (tmp_path / "b.mcap.zst").write_bytes(zstandard.compress(b"no MCAP"))
    recording = open_recording(tmp_path / "a.mcap.zst")
    (copy,) = (tmp_path / "temporary").iterdir()
    _, notes = RecordedScans(recording, recording.point_cloud_topic(), 1.0).mounting(ScanSettings())
    assert notes[0].startswith(f"{tmp_path / 'a.mcap.zst'}: unpacked to {copy} for this run")
    assert notes[1] == "/lidar: 3 scans"
    with pytest.raises(ScanError, match=r"b\.mcap\.zst: not a readable MCAP"):
        open_recording(tmp_path / "b.mcap.zst")
    del recording
    gc.collect()
    assert list((tmp_path / "temporary").iterdir()) == []


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.mcap.zstd", zstd_zeros(2**33, stated=True)),
        ("a.db3.zst", zstd_zeros(2**33, stated=False)),
        ("a.bag.gz", gzip.compress(bytes(2**25))),
    ],
    ids=["stated", "not stated", "gzip"],
)
def test_files_that_unpack_to_gigabytes_are_refused(
    tmp_path: Path, name: str, content: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(messages, "MAX_FILE_BYTES", 2**24)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ScanError, match=rf"{name}: unpacks to more than .* unpack it yourself \((zstd -d|gunzip)\)"):
        open_recording(tmp_path / name)


def test_a_full_disk_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.mcap.zst").write_bytes(ZSTD)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: type("Usage", (), {"free": 10}))
    with pytest.raises(ScanError, match=r"a\.mcap\.zst: unpacks to \d+ bytes, and .* has room for 10; set TMPDIR"):
        open_recording(tmp_path / "a.mcap.zst")


def test_messages_that_unpack_to_gigabytes_cost_themselves(tmp_path: Path) -> None:
    messages: list[tuple[int, Any]] = clouds(3)
    messages[1] = (messages[1][0], zstd_zeros(2**33, stated=True))
    found = read_scans(write_mcap(tmp_path / "a.mcap", {"/lidar": messages}))
    assert [one.scan is not None for one in found] == [True, False, True]


def test_a_rosbag2_of_several_files(tmp_path: Path) -> None:
    """It is one recording, in the order of the numbers; one file that is missing or damaged costs itself."""
    folder, everything = tmp_path / "bag", clouds(12)
    for part in range(12):
        write_mcap(folder / f"bag_{part}.mcap", {"/lidar": everything[part : part + 1]})
    with pytest.raises(ScanError, match="12 recordings, and no metadata"):
        open_recording(folder)
    for names in ("", ", ".join(f"bag_{part}.mcap" for part in range(12))):
        (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information: {{relative_file_paths: [{names}]}}")
        assert times(folder) == stamps(12), "10 comes after 9"
        assert open_recording(folder).point_cloud_topic().messages == 12
    (folder / "bag_1.mcap").unlink()
    (folder / "bag_3.mcap").write_bytes(b"torn")
    recording = open_recording(folder)
    assert [one.recorded_ns for one in recording.messages("/lidar")] == [stamps(3)[0], stamps(3)[2], *stamps(12)[4:]]
    assert recording.damage == f"{folder}: bag_1.mcap is missing"


# --- ROS 1


def rosbag1(path: Path, compression: Any, count: int = 3) -> Path:
    one = store(ros1=True)
    writer = Writer1(path)
    writer.set_compression(compression)
    writer.chunk_threshold = 1  # a chunk for each message
    with writer:
        connection = writer.add_connection("/lidar", CLOUD, typestore=one)
        for index, time_ns in enumerate(stamps(count)):
            message = point_cloud2(one, time_ns, cloud_points(index))
            writer.write(connection, time_ns, serialized(message, CLOUD, ros1=True))
    return path


@pytest.mark.parametrize("compression", ["BZ2", "LZ4"])
def test_a_damaged_chunk_of_a_bag_costs_its_messages_alone(tmp_path: Path, compression: str) -> None:
    path = rosbag1(tmp_path / "a.bag", Writer1.CompressionFormat[compression], 5)
    assert times(path) == stamps(5)
    with Reader1(path) as reader:
        chunk = sorted(reader.chunks.values(), key=lambda one: one.datapos)[2]
    data = bytearray(path.read_bytes())
    data[chunk.datapos + 30 : chunk.datapos + 60] = bytes(30)
    path.write_bytes(data)
    recording = open_recording(path)
    found = [one.recorded_ns for one in recording.messages("/lidar")]
    assert found == [*stamps(5)[:2], *stamps(5)[3:]]
    assert "4 of the 5 messages of /lidar can be read" in str(recording.damage)


@pytest.mark.parametrize("compression", ["BZ2", "LZ4"])
def test_a_chunk_of_a_bag_unpacks_to_no_more_than_the_limit(
    tmp_path: Path, compression: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(messages, "MAX_BYTES", 300)
    monkeypatch.setattr(messages, "MAX_RATIO", 0)
    recording = open_recording(rosbag1(tmp_path / "a.bag", Writer1.CompressionFormat[compression]))
    assert list(recording.messages("/lidar")) == []
    assert "unpack to more than 300" in str(recording.damage)
