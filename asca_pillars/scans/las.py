"""The LAS format of the ASPRS, and LAZ, its compressed form, as surveying software and Livox Viewer export them."""

import struct
from pathlib import Path

import numpy as np

from asca_pillars.base.errors import AscaError, ScanError
from asca_pillars.base.installation import install_command
from asca_pillars.scans.records import AGAIN, MAX_POINTS, Field, StoredPoints, assemble_points

_EARLIER_HEADER_BYTES, _HEADER_BYTES = 227, 375  # of LAS before and from version 1.4 on
_VLR_BYTES, _EVLR_BYTES = 54, 60  # of a variable-length record's own header


def read_las(path: Path) -> StoredPoints:
    """Read the points of a `.las` or `.laz` file, with the stored intensity.

    Raises:
        ScanError: not such a file, a damaged one, or one of too many points.
        AscaError: laspy is not installed.
    """
    try:
        import laspy
    except ModuleNotFoundError:
        raise AscaError(f"{path}: laspy not installed: {install_command('import')}") from None
    if not _records_fit(path):
        raise ScanError(f"{path}: not the header of a LAS file, or one of more records than the file holds; {AGAIN}")
    try:
        with laspy.open(path) as reader:
            header, count = reader.header, reader.header.point_count
            least = header.offset_to_point_data + (
                0 if header.are_points_compressed else count * header.point_format.size
            )
            if least > path.stat().st_size:
                raise ValueError(f"{count} points do not fit into it")
            points = reader.read() if count <= MAX_POINTS else None
    except (OSError, MemoryError):
        raise
    except Exception as error:  # damage shows in errors of laspy, lazrs, struct and NumPy
        raise ScanError(f"{path}: not a readable LAS file ({' '.join(str(error).split())[:100]}); {AGAIN}") from error
    if points is None:
        raise ScanError(f"{path}: {count} points are more than {MAX_POINTS}; cut the recording into scans")
    if len(points) != count:
        raise ScanError(f"{path}: {len(points)} points where the header states {count}; {AGAIN}")
    with np.errstate(over="ignore", invalid="ignore"):
        columns = [np.asarray(points[name]) for name in ("x", "y", "z", "intensity")]
    return assemble_points(count, columns, [Field("", column.dtype) for column in columns])


def _records_fit(path: Path) -> bool:
    """Return whether the variable-length records that the header states fit into the file.

    laspy reads as many as are stated, four billion in a damaged header, although nothing follows.
    """
    with path.open("rb") as file:
        header = file.read(_HEADER_BYTES)
    if header[:4] != b"LASF" or len(header) < _EARLIER_HEADER_BYTES:
        return False
    (records,) = struct.unpack_from("<I", header, 100)
    is_1_4 = header[25] >= 4 and len(header) == _HEADER_BYTES
    (extended,) = struct.unpack_from("<I", header, 243) if is_1_4 else (0,)
    return records * _VLR_BYTES + extended * _EVLR_BYTES <= path.stat().st_size
