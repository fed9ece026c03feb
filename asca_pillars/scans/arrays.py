"""Points from NumPy arrays, of `.npy` files and of callers."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.records import AGAIN, MAX_POINTS, StoredPoints

_MANY_COLUMNS = 8


def read_npy(path: Path) -> StoredPoints:
    """Read the points of a NumPy array (N, 3 or more) of real numbers.

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

    Points of a masked array with a masked coordinate or reflectance are left out; remarks give their number.

    Raises:
        ScanError: another shape, too many points, or not real numbers.
    """
    if array.ndim == 2 and array.shape[0] in (3, 4) and array.shape[1] > _MANY_COLUMNS:
        raise ScanError(f"{source}: of shape {array.shape}, points lie in its columns; transpose it (array.T)")
    if array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind not in "iuf":
        raise ScanError(
            f"{source}: holds {array.dtype} of shape {array.shape}; save real numbers of shape (N, 3) or (N, 4)"
        )
    if len(array) > MAX_POINTS:
        raise ScanError(f"{source}: {len(array)} points are more than {MAX_POINTS}; cut the recording into scans")
    remarks: tuple[str, ...] = ()
    if isinstance(array, np.ma.MaskedArray):
        masked = np.ma.getmaskarray(array)[:, :4].any(axis=1)
        array = np.asarray(array.data)[~masked]
        remarks = (f"{masked.sum()} masked points left out",) if masked.any() else ()
    with np.errstate(over="ignore", invalid="ignore"):
        xyz = array[:, :3].astype(np.float32)
    reflectance = np.asarray(array[:, 3]) if array.shape[1] > 3 else None
    return StoredPoints(xyz, reflectance, array.dtype, remarks)
