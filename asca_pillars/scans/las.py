"""The LAS format of the ASPRS, and LAZ, its compressed form, as surveying software and Livox Viewer export them."""

import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np

from asca_pillars.base.errors import AscaError, ScanError
from asca_pillars.base.installation import install_command
from asca_pillars.scans.records import AGAIN, Field, StoredPoints, assemble_points, require_few_points

_EARLIER_HEADER_BYTES, _HEADER_BYTES = 227, 375  # of LAS before and from version 1.4 on
_VLR_BYTES, _EVLR_BYTES = 54, 60  # of a variable-length record's own header
_COMPRESSED = 0x80  # in the point format
_TABLE_AT_END = -1  # of a file written to a stream: the last eight bytes tell where the table of chunks is


def read_las(path: Path) -> StoredPoints:
    """Read the points of a `.las` or `.laz` file, with the stored intensity.

    Raises:
        ScanError: not such a file, a damaged one, or one of too many points.
        AscaError: laspy or lazrs is not installed.
    """
    try:
        import laspy
        import lazrs  # noqa: F401  with which laspy reads .laz
    except ModuleNotFoundError as error:
        raise AscaError(f"{path}: {error.name} not installed: {install_command('import')}") from None
    if not _records_fit(path):
        raise ScanError(f"{path}: not the header of a LAS file, or one of more records than the file holds; {AGAIN}")
    try:
        with laspy.open(path) as reader:
            header, count = reader.header, reader.header.point_count
            require_few_points(str(path), count)
            room = path.stat().st_size - header.offset_to_point_data
            if not header.are_points_compressed and count * header.point_format.size > room:
                raise ValueError(f"{count} points do not fit into it")
            points = reader.read()
    except (ScanError, OSError, MemoryError, KeyboardInterrupt):
        raise
    except BaseException as error:  # damage shows in errors of laspy, struct and NumPy, and in panics of lazrs
        raise ScanError(f"{path}: not a readable LAS file ({' '.join(str(error).split())[:100]}); {AGAIN}") from error
    if len(points) != count:
        raise ScanError(f"{path}: {len(points)} points where the header states {count}; {AGAIN}")
    with np.errstate(over="ignore", invalid="ignore"):
        columns = [np.asarray(points[name]) for name in ("x", "y", "z", "intensity")]
    return assemble_points(count, columns, [Field("", column.dtype) for column in columns])


def _records_fit(path: Path) -> bool:
    """Return whether the file can hold the variable-length records and the compressed chunks that it states.

    laspy reads as many records as are stated, four billion in a damaged header, although nothing follows, and lazrs
    ends the process where there is no memory for so many chunks.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        header = file.read(_HEADER_BYTES)
        if header[:4] != b"LASF" or len(header) < _EARLIER_HEADER_BYTES:
            return False
        start, records = struct.unpack_from("<2I", header, 96)
        is_1_4 = header[25] >= 4 and len(header) == _HEADER_BYTES
        (extended,) = struct.unpack_from("<I", header, 243) if is_1_4 else (0,)
        chunks = _chunks(file, start, size) if header[104] & _COMPRESSED else 0
    return records * _VLR_BYTES + extended * _EVLR_BYTES + chunks <= size


def _chunks(file: BinaryIO, start: int, size: int) -> int:
    """Return the number of chunks in the table to which the compressed points at `start`, or the last bytes, point."""
    for place in (start, size - 8):
        file.seek(max(place, 0))
        (table,) = struct.unpack("<q", file.read(8).ljust(8, b"\0"))
        if table != _TABLE_AT_END:
            break
    if not 0 <= table <= size:
        return 0  # there is no table, as laspy will find
    file.seek(table)
    return int.from_bytes(file.read(8)[4:], "little")
