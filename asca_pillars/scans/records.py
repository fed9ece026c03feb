"""Points from records with named fields, which the PCD and PLY readers share, and from NumPy arrays."""

import math
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ScanError

AGAIN = "the file is damaged or incomplete: copy or export it again"
MAX_HEADER_BYTES = 65_536
MAX_POINTS = 50_000_000
"""Largest number of points in a file: ten times what the densest sensors measure in a second."""

_REFLECTANCE = ("intensity", "reflectance", "reflectivity", "i")
_DIGITS = re.compile(r"[0-9]{1,18}")


@dataclass(frozen=True)
class Field:
    """Field of a point: `count` values of `dtype`, in the file's byte order and without padding."""

    name: str
    dtype: np.dtype[np.generic]
    count: int = 1

    @property
    def size_bytes(self) -> int:
        """Size of the whole field in one point, bytes."""
        return self.dtype.itemsize * self.count


class StoredPoints(NamedTuple):
    """Points of a file: `xyz` (N, 3) float32 in m, `reflectance` (N,) of any scale, or None if there is none.

    `dtype` is the type that the file declares for the reflectance; `remarks` are the reader's decisions.
    """

    xyz: NDArray[np.float32]
    reflectance: NDArray[np.generic] | None
    dtype: np.dtype[np.generic] | None
    remarks: tuple[str, ...] = ()


def require_few_points(source: str, count: int) -> None:
    """Raise ScanError if there are more points than a scan has, MAX_POINTS."""
    if count > MAX_POINTS:
        raise ScanError(f"{source}: {count} points are more than {MAX_POINTS}; cut the recording into scans")


def whole_number(word: str) -> int | None:
    """Parse a word of decimal digits; return None if it is anything else, or too long."""
    return int(word) if _DIGITS.fullmatch(word) else None


def points_from_text(source: str, lines: Sequence[bytes], fields: Sequence[Field], count: int) -> StoredPoints:
    """Parse `count` points of the lines of an ASCII body: one point per line, field by field.

    Raises:
        ScanError: lines are missing, not as long as the fields, or not of numbers; or there is no x, y and z.
    """
    selected, width = select_fields(source, fields), sum(field.count for field in fields)
    if len(lines) < count:
        raise ScanError(f"{source}: {len(lines)} lines where {count} points need {count}; {AGAIN}")
    rows = [line.split() for line in lines[:count]]
    # If the lines were joined unchecked, a missing value would shift all later ones into other columns.
    for number, row in enumerate(rows):
        if len(row) != width:
            raise ScanError(f"{source}: point {number} has {len(row)} values where the fields need {width}; {AGAIN}")
    if any(b"_" in line for line in lines[:count]):  # Python parses 1_000 as a number
        raise ScanError(f"{source}: a point has a word with _ in it, no number; {AGAIN}")
    try:
        table = np.array(rows, dtype=np.float64).reshape(count, width)
    except ValueError as error:
        raise ScanError(f"{source}: {error}; {AGAIN}") from error
    starts = np.cumsum([0] + [field.count for field in fields])
    return assemble_points(
        count, [table[:, starts[index]] for index in selected], [fields[index] for index in selected]
    )


def points_from_bytes(
    source: str, data: bytes | bytearray, fields: Sequence[Field], count: int, *, by_field: bool = False
) -> StoredPoints:
    """Read `count` points of a binary body: point by point, or (`by_field`) field by field.

    Raises:
        ScanError: the body is shorter than `count` points, or the fields hold no x, y and z.
    """
    selected, size = select_fields(source, fields), sum(field.size_bytes for field in fields)
    if len(data) < count * size:
        raise ScanError(f"{source}: {len(data)} bytes where {count} points need {count * size}; {AGAIN}")
    raw = np.frombuffer(data, dtype=np.uint8, count=count * size)
    columns = []
    for index in selected:
        start, field = sum(f.size_bytes for f in fields[:index]), fields[index]
        if by_field:
            column = raw[start * count : (start + field.size_bytes) * count]
        else:
            column = np.ascontiguousarray(raw.reshape(count, size)[:, start : start + field.size_bytes])
        columns.append(column.reshape(-1).view(field.dtype))
    return assemble_points(count, columns, [fields[index] for index in selected])


def select_fields(source: str, fields: Sequence[Field]) -> list[int]:
    """Return the indices of x, y, z and, if present, the reflectance. CloudCompare writes scalar_Intensity.

    Raises:
        ScanError: a coordinate is missing, or one of them occurs twice or has several values per point.
    """
    names = [field.name.lower().removeprefix("scalar_") for field in fields]
    if missing := [name for name in "xyz" if name not in names]:
        raise ScanError(
            f"{source}: no field {', '.join(missing)} among {', '.join(names) or 'none'}; export x, y and z"
        )
    selected = [names.index(name) for name in "xyz"]
    selected += [names.index(name) for name in _REFLECTANCE if name in names][:1]
    for index in selected:
        if fields[index].count != 1:
            raise ScanError(f"{source}: {names[index]} has {fields[index].count} values per point; export one")
        if names.count(names[index]) > 1:
            raise ScanError(f"{source}: there are {names.count(names[index])} fields {names[index]}; export one")
    return selected


def assemble_points(count: int, columns: Sequence[NDArray[np.generic]], fields: Sequence[Field]) -> StoredPoints:
    """Return points of columns (N,) x, y, z in metres and optional reflectances, with the field of each."""
    xyz = np.zeros((count, 3), dtype=np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for axis, column in enumerate(columns[:3]):
            xyz[:, axis] = column
    return StoredPoints(xyz, columns[3], fields[3].dtype) if len(columns) > 3 else StoredPoints(xyz, None, None)


_MANY_COLUMNS = 8


def read_npy(path: Path) -> StoredPoints:
    """Read the points of a NumPy array (N, 3 or more) of real numbers, or of records with the fields x, y and z.

    Raises:
        ScanError: not such an array, or a transposed one.
    """
    # Memory-mapped, not loaded: the header is compared with the file's size before memory is allocated, and
    # pickled objects are refused.
    try:
        with warnings.catch_warnings():
            # NumPy parses the header as Python source, for which Python may print warnings.
            warnings.simplefilter("error", SyntaxWarning)
            warnings.simplefilter("error", DeprecationWarning)
            array = np.lib.format.open_memmap(path, mode="r")
    except OSError:
        raise
    except Exception as error:  # NumPy does not catch the tokenizer's errors
        reason = " ".join(str(error).split())[:100]
        raise ScanError(f"{path}: not an array of numbers ({reason}); {AGAIN}") from error
    return points_from_array(array, str(path))


def points_from_array(array: NDArray[Any], source: str = "points") -> StoredPoints:
    """Convert an array (N, >=3) to points: x, y, z, and reflectance if there is a fourth column.

    Records, a structured array of any shape, are read by the names of their fields, as a PCD is. Points of a masked
    array with a masked coordinate or reflectance are left out; remarks give their number.

    Raises:
        ScanError: another shape, too many points, or not real numbers.
    """
    if array.dtype.names is not None:
        return _points_from_records(array, source)
    if array.ndim == 2 and array.shape[0] in (3, 4) and array.shape[1] > _MANY_COLUMNS:
        raise ScanError(f"{source}: of shape {array.shape}, points lie in its columns; transpose it (array.T)")
    if array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind not in "iuf":
        raise ScanError(
            f"{source}: holds {array.dtype} of shape {array.shape}; save real numbers of shape (N, 3) or (N, 4)"
        )
    require_few_points(source, len(array))
    remarks: tuple[str, ...] = ()
    if isinstance(array, np.ma.MaskedArray):
        masked = np.ma.getmaskarray(array)[:, :4].any(axis=1)
        array = np.asarray(array.data)[~masked]
        remarks = (f"{masked.sum()} masked points left out",) if masked.any() else ()
    with np.errstate(over="ignore", invalid="ignore"):
        xyz = array[:, :3].astype(np.float32)
    reflectance = np.asarray(array[:, 3]) if array.shape[1] > 3 else None
    return StoredPoints(xyz, reflectance, array.dtype, remarks)


def _points_from_records(array: NDArray[Any], source: str) -> StoredPoints:
    """Convert a structured array to points, such as those that ros_numpy and pypcd4 give."""
    fields = [Field(name, kind.base, math.prod(kind.shape)) for name, (kind, *_) in (array.dtype.fields or {}).items()]
    selected = [fields[index] for index in select_fields(source, fields)]
    if wrong := [field for field in selected if field.dtype.kind not in "iuf"]:
        raise ScanError(f"{source}: field {wrong[0].name} holds {wrong[0].dtype}; save real numbers")
    require_few_points(source, array.size)
    return assemble_points(array.size, [array[field.name].reshape(-1) for field in selected], selected)
