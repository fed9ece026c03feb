"""Point records with named fields, which the PCD and PLY formats share once their headers are read."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asca_pillars.errors import ScanError

AGAIN = "the file is damaged or incomplete: copy or export it again"
_REFLECTANCE = ("intensity", "reflectance", "i")


@dataclass(frozen=True)
class Field:
    """A field of one point: `count` values of `dtype`, in the file's byte order and without padding."""

    name: str
    dtype: np.dtype[np.generic]
    count: int = 1

    @property
    def size_bytes(self) -> int:
        return self.dtype.itemsize * self.count


def whole_number(word: str) -> int | None:
    """The number that a word writes in decimal digits; None if it is anything else, or absurdly long."""
    return int(word) if word.isdecimal() and len(word) <= 18 else None


def unit_reflectance(values: NDArray[np.generic]) -> NDArray[np.float32]:
    """Reflectance (N,) as float32 in 0..1, or NaN where `values` are not finite.

    Sensors and exporters write either 0..1 or 0..255, and no format says which. Integers, and any scan with a
    value above 1, are taken as 0..255; the rest is taken as it is. A sensor with yet another range (0..65535)
    saturates at 1, which the comparison of a scan with the input that a bundle expects reports.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        reflectance = values.astype(np.float32)
        finite = np.isfinite(reflectance)
        if values.dtype.kind in "iu" or reflectance.max(initial=0, where=finite) > 1:
            reflectance = reflectance / np.float32(255)
        return np.where(finite, np.clip(reflectance, 0, 1), np.float32(np.nan))


def points_from_text(source: str, words: Sequence[bytes], fields: Sequence[Field], count: int) -> NDArray[np.float32]:
    """Points (count, 4) from the words of an ASCII body, `fields` after `fields`, point after point.

    Raises:
        ScanError: words are missing or not numbers, or the fields hold no x, y and z.
    """
    width = sum(field.count for field in fields)
    if len(words) < count * width:
        raise ScanError(f"{source}: {len(words)} numbers where {count} points need {count * width}; {AGAIN}")
    try:
        table = np.array(words[: count * width], dtype=np.float64).reshape(count, width)
    except ValueError as error:
        raise ScanError(f"{source}: {error}; {AGAIN}") from error
    starts = np.cumsum([0] + [field.count for field in fields])
    # In its declared type, because `unit_reflectance` treats integers as 0..255.
    with np.errstate(over="ignore", invalid="ignore"):
        columns = [table[:, starts[index]].astype(fields[index].dtype) for index in _wanted(source, fields)]
    return _assemble(count, columns)


def points_from_bytes(
    source: str, data: bytes | bytearray, fields: Sequence[Field], count: int, *, by_field: bool = False
) -> NDArray[np.float32]:
    """Points (count, 4) from a binary body: point after point, or (`by_field`) field after field.

    Raises:
        ScanError: the body is shorter than `count` points, or the fields hold no x, y and z.
    """
    size = sum(field.size_bytes for field in fields)
    if len(data) < count * size:
        raise ScanError(f"{source}: {len(data)} bytes where {count} points need {count * size}; {AGAIN}")
    raw = np.frombuffer(data, dtype=np.uint8, count=count * size)
    columns = []
    for index in _wanted(source, fields):
        start, field = sum(f.size_bytes for f in fields[:index]), fields[index]
        if by_field:
            column = raw[start * count : (start + field.size_bytes) * count]
        else:
            column = np.ascontiguousarray(raw.reshape(count, size)[:, start : start + field.size_bytes])
        columns.append(column.reshape(-1).view(field.dtype))
    return _assemble(count, columns)


def _wanted(source: str, fields: Sequence[Field]) -> list[int]:
    """Indices of x, y, z and, where there is one, the reflectance. CloudCompare writes scalar_Intensity."""
    names = [field.name.lower().removeprefix("scalar_") for field in fields]
    if missing := [name for name in "xyz" if name not in names]:
        raise ScanError(
            f"{source}: no field {', '.join(missing)} among {', '.join(names) or 'none'}; export x, y and z"
        )
    wanted = [names.index(name) for name in "xyz"]
    wanted += [names.index(name) for name in _REFLECTANCE if name in names][:1]
    for index in wanted:
        if fields[index].count != 1:
            raise ScanError(f"{source}: {names[index]} has {fields[index].count} values per point; export one")
    return wanted


def _assemble(count: int, columns: Sequence[NDArray[np.generic]]) -> NDArray[np.float32]:
    points = np.zeros((count, 4), dtype=np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for axis, column in enumerate(columns[:3]):
            points[:, axis] = column
    if len(columns) > 3:
        points[:, 3] = unit_reflectance(columns[3])
    return points
