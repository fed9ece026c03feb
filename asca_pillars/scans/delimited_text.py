"""Points as text: a line for each, its values between commas, semicolons, tabs or spaces, with or without names."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.records import AGAIN, Field, StoredPoints, assemble_points, require_few_points, select_fields

_UNIT = re.compile(r"\s*[(\[].*")
_FIRST_COLUMNS = ("x", "y", "z", "intensity")
_ALIASES = {
    **{f"{name}:{axis}": "xyz"[axis] for name in ("points_m_xyz", "points") for axis in range(3)},  # VeloView
    **{f"{axis}1": axis for axis in "xyz"},  # first returns in files of ouster-cli
}


def read_delimited_text(path: Path) -> StoredPoints:
    """Read the points of a text file, such as VeloView, Livox Viewer, ouster-cli and CloudCompare export.

    A line before the points, which may begin with # or //, names the columns, in either case and with or without a unit
    in brackets. Without names the first three are x, y and z in metres, and a fourth is the reflectance.

    Raises:
        ScanError: the names lack x, y or z, values are missing or are no numbers, or there are too many points.
    """
    text = path.read_bytes().decode("utf-8-sig", errors="replace")
    names, lines = _split_header(path, [line for line in text.splitlines() if line.strip()])
    require_few_points(str(path), len(lines))
    width = len(_values(lines[0])) if lines else len(names)
    remarks: tuple[str, ...] = ()
    if not names:
        names = [*_FIRST_COLUMNS, *[""] * width][:width]
        if width > len(_FIRST_COLUMNS):
            remarks = (f"the fourth of {width} columns without names was taken as the reflectance",)
    elif len(names) != width:
        raise ScanError(f"{path}: {len(names)} names above points of {width} values; {AGAIN}")
    fields = [Field(name, np.dtype(np.float64)) for name in names]
    selected = select_fields(str(path), fields)
    columns = list(_numbers(path, lines, selected, width).T)
    return assemble_points(len(lines), columns, [fields[index] for index in selected])._replace(remarks=remarks)


def _split_header(path: Path, lines: Sequence[str]) -> tuple[list[str], Sequence[str]]:
    """Return the names of the columns, none if the file has none, and the lines of the points."""
    first = next((number for number, line in enumerate(lines) if _is_number(_values(line)[0])), len(lines))
    for number, line in enumerate(lines[:first]):
        words = [_UNIT.sub("", word.strip().strip("\"'").lower()) for word in _values(line.lstrip(" \t#/"))]
        # VeloView's later files have both Points_m_XYZ:0 and X.
        names = [word if _ALIASES.get(word) in words else _ALIASES.get(word, word) for word in words]
        if set("xyz") <= set(names):
            return names, lines[number + 1 :]
    if first == len(lines):
        raise ScanError(f"{path}: no names x, y and z and no line that begins with a number; {AGAIN}")
    if first and not lines[first - 1].lstrip().startswith(("#", "//")):
        raise ScanError(
            f"{path}: {lines[first - 1].strip()[:60]!r} above the points does not name x, y and z; name the columns "
            "or delete the line"
        )
    return [], lines[first:]


def _numbers(path: Path, lines: Sequence[str], columns: Sequence[int], width: int) -> NDArray[np.float64]:
    """Return columns of lines as an array (N, len(columns)); other columns may hold other things than numbers."""
    if not lines:
        return np.zeros((0, len(columns)))
    separator = _separator(lines[0])
    if separator == ";" and "," in lines[0]:
        raise ScanError(f"{path}: numbers are written with commas ({lines[0].strip()[:40]!r}); write them with points")
    # Values that are missing would shift later ones into other columns.
    for number, line in enumerate(lines):
        if (found := line.count(separator) + 1 if separator else len(line.split())) != width:
            raise ScanError(f"{path}: point {number} has {found} values and the first has {width}; {AGAIN}")
    try:
        return np.loadtxt(lines, delimiter=separator, usecols=columns, comments=None, ndmin=2)
    except ValueError as error:
        raise ScanError(f"{path}: {' '.join(str(error).split())[:100]}; {AGAIN}") from error


def _separator(line: str) -> str | None:
    """Return what stands between the values of a line; None for spaces."""
    return next((separator for separator in ";,\t" if separator in line), None)


def _values(line: str) -> list[str]:
    return line.split(_separator(line)) or [""]


def _is_number(word: str) -> bool:
    try:
        float(word.replace(",", "."))
    except ValueError:
        return False
    return True
