"""Scan files of any common format to points (N, 4) float32: x, y, z in metres, reflectance in 0..1."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.scans.arrays import read_npy
from asca_pillars.data.scans.feather import read_feather
from asca_pillars.data.scans.find_scans import SCAN_SUFFIXES
from asca_pillars.data.scans.pcd import read_pcd
from asca_pillars.data.scans.ply import read_ply
from asca_pillars.data.scans.raw_floats import read_raw_floats
from asca_pillars.data.scans.records import StoredPoints
from asca_pillars.data.scans.reflectance import (
    ReflectanceScale,
    ambiguity,
    checked_scale,
    unit_reflectance,
)
from asca_pillars.errors import ScanError
from asca_pillars.files import atomic_path

MAX_FILE_BYTES = 8 * 2**30


@dataclass(frozen=True)
class ScanNotes:
    """What reading a scan changed, dropped or had to decide.

    Attributes:
        dropped_points: with a coordinate or reflectance that is not finite.
        clipped_reflectances: outside 0..1 after scaling, and brought to the nearer end.
        reflectance_scale: what stored reflectances were divided by; None if the file has none.
        remarks: sentences for the user, such as that five columns were found.
    """

    dropped_points: int = 0
    clipped_reflectances: int = 0
    reflectance_scale: float | None = None
    remarks: tuple[str, ...] = ()


class Scan(NamedTuple):
    """The finite points (N, 4) float32 of a file, x, y, z in m and reflectance 0..1, and what was done to get them."""

    points: NDArray[np.float32]
    notes: ScanNotes

    @property
    def dropped_points(self) -> int:
        """Points of the file that were not finite."""
        return self.notes.dropped_points


def read_scan(path: str | Path, *, columns: int | None = None, reflectance_scale: ReflectanceScale = "auto") -> Scan:
    """Read a scan by its suffix (`SCAN_SUFFIXES`).

    A file without reflectance gets zeros. Points with a coordinate or reflectance that is not finite are dropped and
    counted. A well-formed file without points is an empty scan. Of each kind of file so much is read as its size
    allows, at most `raw_floats.MAX_POINTS` points or MAX_FILE_BYTES.

    Args:
        path: the file.
        columns: float32 values per point of a `.bin`; None: four (KITTI) or five (nuScenes), by the values.
        reflectance_scale: the stored value that is a reflectance of 1; auto: by the field's type and the values
            (`reflectance.decide_scale`). For a folder of scans decide it once: `stored_scans.folder_reflectance_scale`.

    Raises:
        ScanError: the file is missing, damaged, too large or of an unknown format.
    """
    reflectance_scale = checked_scale(reflectance_scale)
    stored = read_stored(Path(path), columns)
    return finite_scan(stored, reflectance_scale)


def write_scan(path: str | Path, points: NDArray[np.floating]) -> None:
    """Write points (N, 4), N > 0, as KITTI's `.bin`: little-endian float32 x, y, z, reflectance.

    Raises:
        ScanError: there are no points (`.bin` has no header, so that an empty file cannot be told from a lost one), or
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
    """What a file holds, reflectances of any scale; `columns` as in `read_scan`.

    Raises:
        ScanError: as `read_scan`.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise ScanError(f"{path}: unknown suffix '{path.suffix}'; scans are {', '.join(SCAN_SUFFIXES)}")
    try:
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
    """The finite points of what is stored, reflectances divided by `scale`, or by what the values suggest."""
    points = np.zeros((len(stored.xyz), 4), dtype=np.float32)
    points[:, :3] = stored.xyz
    notes = ScanNotes(remarks=stored.remarks)
    if stored.reflectance is not None:
        scaled = unit_reflectance(stored.reflectance, stored.dtype, scale)
        points[:, 3] = scaled.values
        doubt = ambiguity(stored.reflectance, scaled.scale) if scaled.decided_by == "values" else None
        notes = ScanNotes(0, scaled.clipped, scaled.scale, (*stored.remarks, *([doubt] if doubt else [])))
    finite = np.isfinite(points).all(axis=1)
    dropped = len(points) - int(finite.sum())
    return Scan(points[finite] if dropped else points, replace(notes, dropped_points=dropped))


_READERS: dict[str, Callable[[Path], StoredPoints]] = {
    ".bin": read_raw_floats,
    ".npy": read_npy,
    ".pcd": read_pcd,
    ".ply": read_ply,
    ".feather": read_feather,
}
assert tuple(_READERS) == SCAN_SUFFIXES, "find_scans finds what can be read"
