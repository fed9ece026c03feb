"""Reader of scan files of all formats: points (N, 4) float32, x, y, z in metres, reflectance in 0..1."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ScanError
from asca_pillars.base.files import atomic_path, require_content
from asca_pillars.scans.delimited_text import read_delimited_text
from asca_pillars.scans.feather import read_feather
from asca_pillars.scans.find_scans import NAMED_SUFFIXES, SCAN_SUFFIXES
from asca_pillars.scans.las import read_las
from asca_pillars.scans.pcd import read_pcd
from asca_pillars.scans.ply import read_ply
from asca_pillars.scans.records import AGAIN, MAX_POINTS, StoredPoints, read_npy

ReflectanceScale = Literal["auto"] | float
"""Stored value that is a reflectance of 1: 1, 100, 255, 65535, any other positive number, or auto."""

MAX_FILE_BYTES = 8 * 2**30
MAX_COLUMNS = 16
_FAR_M = 1000.0
_MAX_RING = 512
_FEW = 100
_FOUR, _FIVE = "x, y, z, reflectance", "x, y, z, reflectance, ring"

# A few values above a scale are noise or retroreflectors; with a scale that is too small there are always more.
_SHARE_ABOVE = 0.001
_SLACK = 2.0  # a scan stored in 0..255 has many values above 2; values just above 1 are common


@dataclass(frozen=True)
class ScanNotes:
    """Changes, dropped points and decisions of the reader.

    Attributes:
        dropped_points: points with a coordinate or reflectance that is not finite.
        clipped_reflectances: reflectances outside 0..1 after scaling, clipped.
        reflectance_scale: divisor of the stored reflectances; None if the file has none.
        remarks: sentences for the user, such as that five columns were found.
    """

    dropped_points: int = 0
    clipped_reflectances: int = 0
    reflectance_scale: float | None = None
    remarks: tuple[str, ...] = ()


class Scan(NamedTuple):
    """Finite points (N, 4) float32 of a file, x, y, z in m and reflectance 0..1, with the reader's notes."""

    points: NDArray[np.float32]
    notes: ScanNotes

    @property
    def dropped_points(self) -> int:
        """Number of the file's points that were not finite."""
        return self.notes.dropped_points


def read_scan(path: str | Path, *, columns: int | None = None, reflectance_scale: ReflectanceScale = "auto") -> Scan:
    """Read a scan by its suffix (`SCAN_SUFFIXES` and `NAMED_SUFFIXES`).

    A file without reflectance gets zeros. Points with a coordinate or reflectance that is not finite are dropped and
    counted. A well-formed file without points is an empty scan. At most MAX_POINTS points or MAX_FILE_BYTES are
    read.

    Args:
        path: the file.
        columns: float32 values per point of a `.bin`; None: four (KITTI) or five (nuScenes), by the values.
        reflectance_scale: the stored value that is a reflectance of 1; auto: by the field's type and the values
            (`decide_scale`). For a folder of scans decide it once: `scan_settings.folder_reflectance_scale`.

    Raises:
        ScanError: the file is missing, damaged, too large or of an unknown format.
    """
    reflectance_scale = checked_scale(reflectance_scale)
    stored = read_stored(Path(path), columns)
    return finite_scan(stored, reflectance_scale)


def write_scan(path: str | Path, points: NDArray[np.floating]) -> None:
    """Write points (N, 4), N > 0, as KITTI's `.bin`: little-endian float32 x, y, z, reflectance.

    Raises:
        ScanError: there are no points (`.bin` has no header, so an empty file would look like a lost one), or
            the suffix is another.
    """
    if points.ndim != 2 or points.shape[1] != 4:
        raise ValueError(f"points must be (N, 4), not {points.shape}")
    if Path(path).suffix.lower() != ".bin":
        raise ScanError(f"{path}: scans are written as .bin only; choose that suffix")
    if len(points) == 0:
        raise ScanError(f"{path}: a scan without points cannot be written as .bin; leave the frame out")
    with atomic_path(path) as temporary:
        points.astype("<f4").tofile(temporary)


def read_stored(path: Path, columns: int | None) -> StoredPoints:
    """Read the points of a file, reflectances of any scale; `columns` as in `read_scan`.

    Raises:
        ScanError: as `read_scan`.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise ScanError(f"{path}: unknown suffix '{path.suffix}'; scans are {', '.join(_READERS)}")
    try:
        require_content(path, ScanError)
        size = path.stat().st_size
        if size == 0:
            raise ScanError(f"{path}: the file is empty (0 bytes); copy or record it again")
        if size > MAX_FILE_BYTES:
            raise ScanError(f"{path}: {size} bytes, at most {MAX_FILE_BYTES} are read; cut the recording into scans")
        return read_raw_floats(path, columns) if reader is read_raw_floats else reader(path)
    except OSError as error:
        raise ScanError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    except MemoryError:
        raise ScanError(f"{path}: {size} bytes do not fit into memory; cut the recording into scans") from None


def finite_scan(stored: StoredPoints, scale: ReflectanceScale) -> Scan:
    """Return the finite stored points, reflectances divided by `scale`, or by the scale that the values suggest."""
    points = np.zeros((len(stored.xyz), 4), dtype=np.float32)
    points[:, :3] = stored.xyz
    notes = ScanNotes(remarks=stored.remarks)
    if stored.reflectance is not None:
        number, by_values = (float(scale), False) if scale != "auto" else decide_scale(stored.reflectance, stored.dtype)
        points[:, 3], clipped = unit_reflectance(stored.reflectance, number)
        doubt = ambiguity(stored.reflectance, number) if by_values else None
        notes = ScanNotes(0, clipped, number, (*stored.remarks, *([doubt] if doubt else [])))
    finite, dropped = np.isfinite(points), 0
    if not finite.all():  # selecting rows is ten times slower
        kept = points[finite.all(axis=1)]
        points, dropped = kept, len(points) - len(kept)
    return Scan(points, replace(notes, dropped_points=dropped))


def read_raw_floats(path: Path, columns: int | None = None) -> StoredPoints:
    """Read the points of a file of little-endian float32: x, y, z, then (from four columns on) reflectance.

    Args:
        path: the file.
        columns: values per point, 3 to 16; None: four or five, whichever fits the values.

    Raises:
        ScanError: the size is not that of whole points, there are more than MAX_POINTS of them, or both four and five
            columns are plausible.
    """
    if columns is not None and not 3 <= columns <= MAX_COLUMNS:
        raise ScanError(f"columns {columns}: a point has 3 to {MAX_COLUMNS} values")
    size = path.stat().st_size
    if size > MAX_POINTS * 4 * (columns or 4):
        raise ScanError(f"{path}: {size} bytes are more than {MAX_POINTS} points; cut the recording into scans")
    data = np.fromfile(path, dtype="<f4") if size % 4 == 0 else np.zeros(0, np.float32)
    remarks: tuple[str, ...] = ()
    if columns is None:
        columns = _columns(path, size, data)
        remarks = (f"read as {columns} columns ({_FIVE}), which the values fit",) if columns == 5 else ()
    if size % (4 * columns):
        point_size = f"{4 * columns} bytes per point (float32 {_FOUR if columns == 4 else f'in {columns} columns'})"
        raise ScanError(
            f"{path}: file size ({size} byte{'s'[: size != 1]}) is not a multiple of {point_size}; state other columns "
            f"(--columns), or {AGAIN}"
        )
    table = data.reshape(-1, columns)
    reflectance = table[:, 3] if columns > 3 else None
    return StoredPoints(table[:, :3].astype(np.float32), reflectance, np.dtype(np.float32), remarks)


def _columns(path: Path, size: int, data: NDArray[np.float32]) -> int:
    """Return the number of columns: four, unless five fit better.

    Five are plausible if the fifth counts rings (whole and small; all 0 where an exporter left them out). Of such a
    file read in fours, the reflectances are now and then heights or coordinates: negative, as no sensor's are.
    """
    rings = data[4::5]
    if size % 20 or not _plausible(data.reshape(-1, 5)) or not _whole_and_small(rings):
        return 4
    varied = bool((rings != rings[0]).any())
    if not varied and len(rings) < _FEW:
        return 4  # too few to distinguish from a truncated file
    if size % 16 == 0 and _plausible(data.reshape(-1, 4)):
        if not varied:
            return 4
        raise ScanError(f"{path}: may be four columns ({_FOUR}) or five ({_FIVE}); state which (--columns)")
    return 5


def _plausible(table: NDArray[np.float32]) -> bool:
    """Return whether columns can be x, y, z and reflectance: few distant points, few negative reflectances."""
    with np.errstate(invalid="ignore"):
        in_range = (np.abs(table[:, :3]) <= _FAR_M).all(axis=1)
        return bool(((table[:, 3] >= 0) & (table[:, 3] <= 65535) & in_range).mean() >= 0.99)


def _whole_and_small(values: NDArray[np.float32]) -> bool:
    with np.errstate(invalid="ignore"):
        return bool(((values >= 0) & (values < _MAX_RING) & (values == np.floor(values))).all())


def checked_scale(scale: ReflectanceScale) -> ReflectanceScale:
    """Return the scale if it is valid.

    Raises:
        ScanError: it is neither auto nor a positive number.
    """
    if isinstance(scale, str) and scale == "auto":
        return scale
    try:
        number = float(scale)
    except (TypeError, ValueError):
        number = math.nan
    if not (math.isfinite(number) and number > 0):
        raise ScanError(f"reflectance_scale {scale!r}: give auto or the largest value, such as 1, 100, 255 or 65535")
    return number


def unit_reflectance(values: NDArray[np.generic], scale: float) -> tuple[NDArray[np.float32], int]:
    """Return reflectances (N,) divided by `scale`, clipped to 0..1, NaN if not finite; and how many were clipped."""
    with np.errstate(over="ignore", invalid="ignore"):
        reflectance = values.astype(np.float32)
        finite = np.isfinite(reflectance)
        reflectance = np.where(finite, reflectance / np.float32(scale), np.float32(np.nan))
        inside = np.clip(reflectance, 0, 1)
    return inside, int((inside[finite] != reflectance[finite]).sum())


def decide_scale(values: NDArray[np.generic], dtype: np.dtype[np.generic] | None = None) -> tuple[float, bool]:
    """Return the scale of stored reflectances (N,): 1, 255 or 65535; and whether it was decided by their values.

    Bytes are 0..255. Other numbers are taken as 0..1 (integers: as 0..255) unless more than one in a thousand, and
    more than a single one, are too large for it, so that one outlier does not darken a scan.

    Args:
        values: stored values.
        dtype: the type that the file declares for them; None: that of `values`.
    """
    kind = values.dtype if dtype is None else dtype
    if kind.kind in "iu" and kind.itemsize == 1:
        return 255.0, False
    if _many_above(values, 255):
        return 65535.0, True
    if kind.kind in "iu":
        return 255.0, False
    return (255.0 if _many_above(values, _SLACK) else 1.0), True


def ambiguity(values: NDArray[np.generic], scale: float) -> str | None:
    """Return a sentence if reflectances (N,) taken as 0..255 may also be 0..100."""
    if scale != 255 or _many_above(values, 100):
        return None
    return (
        "no reflectance is much above 100 and they were taken as 0..255; if they are 0..100, state that scale "
        "(--reflectance-scale 100)"
    )


def _many_above(values: NDArray[np.generic], limit: float) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):
        above = int((np.greater(values, limit) & np.isfinite(values)).sum())
    return above > max(min(1, len(values) - 1), _SHARE_ABOVE * len(values))


_READERS: dict[str, Callable[[Path], StoredPoints]] = {
    ".bin": read_raw_floats,
    ".npy": read_npy,
    ".pcd": read_pcd,
    ".ply": read_ply,
    ".las": read_las,
    ".laz": read_las,
    ".xyz": read_delimited_text,
    ".feather": read_feather,
    ".csv": read_delimited_text,
    ".txt": read_delimited_text,
}
assert tuple(_READERS) == (*SCAN_SUFFIXES, *NAMED_SUFFIXES), "find_scans finds what can be read"
