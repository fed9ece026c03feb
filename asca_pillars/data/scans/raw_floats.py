"""Scans without a header: float32 values, so many per point. KITTI's `.bin` has four, nuScenes' five."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.scans.records import AGAIN, StoredPoints
from asca_pillars.errors import ScanError

MAX_POINTS = 50_000_000
"""Points that a file may hold; ten times what the densest sensors give in a second."""

MAX_COLUMNS = 16
_FAR_M = 1000.0
_MAX_RING = 512
_FEW = 100
_FOUR, _FIVE = "x, y, z, reflectance", "x, y, z, reflectance, ring"


def read_raw_floats(path: Path, columns: int | None = None) -> StoredPoints:
    """The points of a file of little-endian float32: x, y, z, then (from four columns on) reflectance.

    Args:
        path: the file.
        columns: values of a point, 3 to 16; None: four or five, whichever the values fit.

    Raises:
        ScanError: no whole number of points, more than MAX_POINTS, or both four and five columns are plausible.
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
        raise ScanError(
            f"{path}: {size} bytes are no whole number of points of {4 * columns} (float32 "
            f"{_FOUR if columns == 4 else f'in {columns} columns'}); state other columns "
            f"(--columns), or {AGAIN}"
        )
    table = data.reshape(-1, columns)
    reflectance = table[:, 3] if columns > 3 else None
    return StoredPoints(table[:, :3].astype(np.float32), reflectance, np.dtype(np.float32), remarks)


def _columns(path: Path, size: int, data: NDArray[np.float32]) -> int:
    """Four, unless five fit better.

    Five are plausible if the fifth counts rings (whole and small; all 0 where an exporter left them out). Of such a
    file read in fours, the reflectances are now and then heights or coordinates: negative, as no sensor's are.
    """
    rings = data[4::5]
    if size % 20 or not _plausible(data.reshape(-1, 5)) or not _whole_and_small(rings):
        return 4
    varied = bool((rings != rings[0]).any())
    if not varied and len(rings) < _FEW:
        return 4  # too few to tell from a file that is cut off
    if size % 16 == 0 and _plausible(data.reshape(-1, 4)):
        if not varied:
            return 4
        raise ScanError(f"{path}: may be four columns ({_FOUR}) or five ({_FIVE}); state which (--columns)")
    return 5


def _plausible(table: NDArray[np.float32]) -> bool:
    """Whether columns can be x, y, z and a reflectance: hardly any far away, hardly any negative reflectance."""
    with np.errstate(invalid="ignore"):
        near = (np.abs(table[:, :3]) <= _FAR_M).all(axis=1)
        return bool(((table[:, 3] >= 0) & (table[:, 3] <= 65535) & near).mean() >= 0.99)


def _whole_and_small(values: NDArray[np.float32]) -> bool:
    with np.errstate(invalid="ignore"):
        return bool(((values >= 0) & (values < _MAX_RING) & (values == np.floor(values))).all())
