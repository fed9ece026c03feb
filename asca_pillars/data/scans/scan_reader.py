"""Scan files of any common format to points (N, 4) float32: x, y, z in metres, reflectance in 0..1."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.scans.pcd import read_pcd
from asca_pillars.data.scans.ply import read_ply
from asca_pillars.data.scans.records import AGAIN, unit_reflectance
from asca_pillars.errors import ScanError
from asca_pillars.files import atomic_path

_POINT_BYTES = 16


class Scan(NamedTuple):
    """The finite points (N, 4) float32 of a file, and how many others were dropped."""

    points: NDArray[np.float32]
    dropped_points: int


def read_scan(path: str | Path) -> Scan:
    """Read a scan by its suffix (`SCAN_SUFFIXES`).

    A file without reflectance gets zeros, a scale of 0..255 is brought to 0..1 (`records.unit_reflectance`).
    Points with a coordinate or reflectance that is not finite are dropped and counted. A well-formed file
    without points is an empty scan.

    Raises:
        ScanError: the file is missing, damaged or of an unknown format.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise ScanError(f"{path}: unknown suffix '{path.suffix}'; scans are {', '.join(SCAN_SUFFIXES)}")
    try:
        if path.stat().st_size == 0:
            raise ScanError(f"{path}: the file is empty (0 bytes); copy or record it again")
        points = reader(path)
    except OSError as error:
        raise ScanError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    finite = np.isfinite(points).all(axis=1)
    dropped = len(points) - int(finite.sum())
    return Scan(points[finite] if dropped else points, dropped)


def stored_points(path: Path) -> NDArray[np.float32]:
    """The numbers of a `.bin` scan as they are stored, (N, 4): of any reflectance scale, perhaps not finite.

    Raises:
        ScanError: they are no whole number of points.
    """
    data = path.read_bytes()
    if len(data) % _POINT_BYTES:
        raise ScanError(
            f"{path}: {len(data)} bytes are no whole number of points of {_POINT_BYTES} "
            f"(float32 x, y, z, reflectance); {AGAIN}"
        )
    return np.frombuffer(data, dtype="<f4").reshape(-1, 4).astype(np.float32)


def write_scan(path: str | Path, points: NDArray[np.floating]) -> None:
    """Write points (N, 4), N > 0, as KITTI's `.bin`: little-endian float32 x, y, z, reflectance.

    Raises:
        ScanError: there are no points (`.bin` has no header: nobody could tell the file from a lost one), or
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


def find_scans(path: str | Path) -> list[Path]:
    """The scan at `path`, or those in the folder at `path` in natural order (2.bin before 10.bin).

    Raises:
        ScanError: there is no scan.
    """
    path = Path(path)
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise ScanError(f"{path}: no such file or folder; check the path")
    scans = [entry for entry in path.iterdir() if entry.suffix.lower() in _READERS and entry.is_file()]
    if not scans:
        raise ScanError(f"{path}: no scans in this folder; scans are {', '.join(SCAN_SUFFIXES)}")
    return sorted(scans, key=_natural_order)


def _natural_order(path: Path) -> tuple[list[str | int], str]:
    parts = re.split(r"(\d+)", path.name)
    return [int(part) if part.isdecimal() else part for part in parts], path.name


def _read_bin(path: Path) -> NDArray[np.float32]:
    points = stored_points(path)
    points[:, 3] = unit_reflectance(points[:, 3])
    return points


def _read_npy(path: Path) -> NDArray[np.float32]:
    # Mapped, not loaded: mapping compares the header's claim with the file's size before memory is taken, and
    # refuses pickled objects.
    try:
        array = np.lib.format.open_memmap(path, mode="r")
    except OSError:
        raise
    except Exception as error:  # NumPy reads the header as Python source and lets the tokenizer's errors pass.
        reason = " ".join(str(error).split())[:100]
        raise ScanError(f"{path}: not an array of numbers ({reason}); {AGAIN}") from error
    if array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind not in "iuf":
        raise ScanError(
            f"{path}: holds {array.dtype} of shape {array.shape}; save real numbers of shape (N, 3) or (N, 4)"
        )
    points = np.zeros((len(array), 4), dtype=np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        points[:, :3] = array[:, :3]
    if array.shape[1] > 3:
        points[:, 3] = unit_reflectance(np.asarray(array[:, 3]))
    return points


_READERS = {".bin": _read_bin, ".npy": _read_npy, ".pcd": read_pcd, ".ply": read_ply}
SCAN_SUFFIXES = tuple(_READERS)
