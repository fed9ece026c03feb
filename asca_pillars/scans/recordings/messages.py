"""Messages of a recording: decompressed up to the stated size and a limit, and decoded with the library rosbags.

A few kilobytes can decompress to more than fits into memory. The limit grows with the compressed size.
"""

import shutil
import tempfile
from functools import cache
from pathlib import Path
from typing import IO, Any

from asca_pillars.base.errors import ScanError
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.scans.recordings.recording import Encoding, Message, reason

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
UNPACKERS = {".zstd": "zstd -d", ".zst": "zstd -d", ".bz2": "bunzip2", ".gz": "gunzip", ".lz4": "lz4 -d"}
"""Suffixes of compressed files that are supported, and the program that decompresses them."""
MAX_BYTES, MAX_RATIO = 2**27, 32
"""Largest decompressed size of a message or a chunk: this many bytes, or this many times its own length if more."""
MAX_FILE_BYTES, MAX_FILE_RATIO = 2**28, 100
_BLOCK_BYTES = 2**20
_SHOWN_BYTES = 2**28  # compressed files from this size on show their progress


def decompress_file(source: Path, reporter: Reporter = SILENT) -> Path:
    """Decompress a file of one of UNPACKERS into a temporary folder of its own, which the caller removes.

    Returns:
        path of the copy, which has the name of the file without its last suffix.

    Raises:
        ScanError: the file is damaged at its start, decompresses to too much, or the disk is full.
    """
    folder = Path(tempfile.mkdtemp(prefix="asca-unpacked-"))
    try:
        _decompress_file(source, folder / source.stem, reporter)
    except BaseException as error:
        shutil.rmtree(folder, ignore_errors=True)
        if isinstance(error, ScanError) or not isinstance(error, Exception):
            raise
        if isinstance(error, OSError) and error.errno is not None:  # gzip and bz2 raise OSError for damage
            raise ScanError(
                f"{source}: cannot be unpacked to {folder.parent} ({error.strerror}); set TMPDIR to a folder with room"
            ) from None
        raise ScanError(
            f"{source}: not a readable {source.suffix} file ({reason(error)}); copy or record it again"
        ) from None
    return folder / source.stem


def decompress_zstd(data: bytes, size: int | None = None) -> bytes:
    """Decompress a frame of zstd.

    Args:
        data: the frame.
        size: expected decompressed bytes; None: as stated in the frame.

    Raises:
        ValueError: the frame states or decompresses to another size, or to too much.
        Exception: it is damaged; zstandard has errors of its own.
    """
    from zstandard import ZstdDecompressor, frame_content_size

    stated = frame_content_size(data)  # -1: unknown
    expected = _checked(size if stated < 0 else stated, size, len(data))
    if expected is not None:
        return _whole(ZstdDecompressor().decompress(data, max_output_size=expected), expected)
    with ZstdDecompressor().stream_reader(data) as stream:
        return _within_limit(stream.read(_limit(len(data)) + 1), len(data))


def decompress_lz4(data: bytes, size: int | None = None) -> bytes:
    """Decompress a frame of LZ4; arguments and errors as `decompress_zstd`."""
    from lz4.frame import LZ4FrameDecompressor

    expected = _checked(size, size, len(data))
    unpacker = LZ4FrameDecompressor()
    return _ended(unpacker, unpacker.decompress(data, (expected or _limit(len(data))) + 1), expected, len(data))


def decompress_bz2(data: bytes) -> bytes:
    """Decompress a stream of bzip2; errors as `decompress_zstd`."""
    from bz2 import BZ2Decompressor

    unpacker = BZ2Decompressor()
    return _ended(unpacker, unpacker.decompress(data, _limit(len(data)) + 1), None, len(data))


def _ended(unpacker: object, unpacked: bytes, expected: int | None, packed_bytes: int) -> bytes:
    _within_limit(unpacked, packed_bytes)
    if expected is not None:
        _whole(unpacked, expected)
    if not getattr(unpacker, "eof", False):
        raise ValueError("the end is missing")
    return unpacked


def _limit(packed_bytes: int) -> int:
    return max(MAX_BYTES, MAX_RATIO * packed_bytes)


def _checked(stated: int | None, size: int | None, packed_bytes: int) -> int | None:
    """Return the stated size; ValueError if it differs from the expected one, or is too large."""
    if size is not None and stated != size:
        raise ValueError(f"{stated} bytes where {size} are stated")
    if stated is not None and stated > _limit(packed_bytes):
        raise ValueError(f"{packed_bytes} bytes state that they unpack to {stated}, at most {_limit(packed_bytes)} are")
    return stated


def _whole(unpacked: bytes, expected: int) -> bytes:
    if len(unpacked) != expected:
        raise ValueError(f"{len(unpacked)} bytes or more where {expected} are stated")
    return unpacked


def _within_limit(unpacked: bytes, packed_bytes: int) -> bytes:
    if len(unpacked) > _limit(packed_bytes):
        raise ValueError(f"{packed_bytes} bytes unpack to more than {_limit(packed_bytes)}")
    return unpacked


def _decompress_file(source: Path, target: Path, reporter: Reporter) -> None:
    """Decompress the intact part: readers of the copy report what is missing at its end."""
    from zstandard import frame_content_size

    packed_bytes = source.stat().st_size
    limit = max(MAX_FILE_BYTES, MAX_FILE_RATIO * packed_bytes)
    with source.open("rb") as packed, target.open("wb") as unpacked:
        # The longest header of a zstd frame has 18 bytes.
        stated = frame_content_size(packed.read(18)) if UNPACKERS[source.suffix.lower()] == "zstd -d" else -1
        _refuse_file(source, stated, limit)
        room = shutil.disk_usage(target.parent).free
        if stated > room:
            raise ScanError(
                f"{source}: unpacks to {stated} bytes, and {target.parents[1]} has room for {room}; "
                "set TMPDIR to a folder with more"
            )
        packed.seek(0)
        written = 0
        with _stream(packed, source.suffix.lower()) as stream:
            try:
                while block := stream.read1(_BLOCK_BYTES):  # also what is intact before damage
                    written += len(block)
                    _refuse_file(source, written, limit)
                    unpacked.write(block)
                    if packed_bytes >= _SHOWN_BYTES:
                        reporter.progress(f"Unpacking {source.name}", packed.tell(), packed_bytes)
            except Exception as error:  # each library has errors of its own
                is_damage = not isinstance(error, ScanError) and getattr(error, "errno", None) is None
                if not (is_damage and written):
                    raise


def _stream(packed: IO[bytes], suffix: str) -> Any:
    """Open a file for reading its decompressed bytes, across several frames."""
    if suffix == ".bz2":
        import bz2

        return bz2.open(packed)
    if suffix == ".gz":
        import gzip

        return gzip.open(packed)
    if suffix == ".lz4":
        import lz4.frame

        return lz4.frame.open(packed)
    from zstandard import ZstdDecompressor

    return ZstdDecompressor().stream_reader(packed, read_across_frames=True, closefd=False)


def _refuse_file(source: Path, size: int, limit: int) -> None:
    if size > limit:
        raise ScanError(
            f"{source}: unpacks to more than {limit} bytes, {MAX_FILE_RATIO} times its size or more; if that is right, "
            f"unpack it yourself ({UNPACKERS[source.suffix.lower()]}) and give the result"
        )


_OTHER_TYPES = {
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",  # not among ROS 1's common messages
    "ouster_sensor_msgs/msg/PacketMsg": "uint8[] buf",
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets",
}
"""Types that the library does not define."""


def decode_message(message: Message, kind: str) -> Any:
    """Decode a stored message of a type such as sensor_msgs/msg/PointCloud2 by ROS' own definitions.

    Raises:
        Exception: it is damaged; the library does not catch struct's and NumPy's errors.
    """
    store = typestore(message.encoding)
    if message.encoding == "ros1":
        return store.deserialize_ros1(message.data, kind)
    if message.encoding != "cdr":
        raise ValueError(f"encoded as {message.encoding}; cdr and ros1 are read")
    return store.deserialize_cdr(decompress_message(message), kind)


def decompress_message(message: Message) -> bytes:
    """Return the bytes of a message; rosbag2 states its compression in its metadata.yaml alone.

    Raises:
        Exception: they are damaged.
    """
    # CDR cannot begin with these bytes.
    return decompress_zstd(message.data) if message.data.startswith(ZSTD_MAGIC) else message.data


def time_of(header: Any, message: Message) -> int | None:
    """Return the time stamp of a message, nanoseconds: of its header, or if that is 0 or less of its recording.

    None if neither is known.
    """
    time_ns = int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
    return time_ns if time_ns > 0 else message.recorded_ns


@cache
def typestore(encoding: Encoding) -> Any:
    """Return the standard definitions; the types read here have not changed since ROS 1."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    for name, definition in _OTHER_TYPES.items():
        if name not in store.types:
            store.register(get_types_from_msg(definition, name))
    return store
