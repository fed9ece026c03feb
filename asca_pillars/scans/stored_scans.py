"""Scans with their stored values, and one reflectance scale for scans of the same source."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ScanError
from asca_pillars.scans.records import StoredPoints
from asca_pillars.scans.scan_reader import ReflectanceScale, ambiguity, decide_scale, read_stored


class FolderScale(NamedTuple):
    """Reflectance scale of scans of the same source, and the reason why it may be wrong, if any."""

    scale: ReflectanceScale
    doubt: str | None


def folder_reflectance_scale(paths: Sequence[Path], *, columns: int | None = None, sample: int = 16) -> FolderScale:
    """Return one reflectance scale for scans of the same source, from `sample` of them, evenly spaced.

    A dark scan among brighter ones is then read on the same scale. Scans that cannot be read, or have no points,
    are ignored; where none has reflectances, the scale is auto.
    """
    chosen = paths if len(paths) <= sample else [paths[i * len(paths) // sample] for i in range(sample)]
    stored = []
    for path in chosen:
        with suppress(ScanError):
            stored.append(read_stored(path, columns))
    return common_reflectance_scale(stored)


def common_reflectance_scale(stored: Sequence[StoredPoints]) -> FolderScale:
    """Return one reflectance scale for scans of the same source: the largest scale of any of them.

    Auto where none of them has reflectances; scans without points are ignored.
    """
    samples = [(one.reflectance, one.dtype) for one in stored if one.reflectance is not None and has_finite_point(one)]
    if not samples:
        return FolderScale("auto", None)
    decided = [decide_scale(*one) for one in samples]
    scale = max(scale for scale, _ in decided)
    guessed = any(by_values for _, by_values in decided)
    doubts = [ambiguity(values, scale) for values, _ in samples] if guessed else [None]
    return FolderScale(scale, doubts[0] if all(doubts) else None)


def has_finite_point(stored: StoredPoints) -> bool:
    """Return whether a point has only finite numbers: drivers send scans without any while a sensor starts."""
    finite = np.isfinite(stored.xyz).all(axis=1)
    return bool((finite if stored.reflectance is None else finite & np.isfinite(stored.reflectance)).any())


def stored_points(path: Path, *, columns: int | None = 4) -> NDArray[np.float32]:
    """Read the stored values of a scan, (N, 4): of any reflectance scale, possibly not finite.

    Args:
        path: the file.
        columns: float32 values per point of a `.bin`, as in `read_scan`.

    Raises:
        ScanError: as `read_scan`.
    """
    stored = read_stored(path, columns)
    reflectance = np.zeros(len(stored.xyz)) if stored.reflectance is None else stored.reflectance
    return np.column_stack([stored.xyz, reflectance.astype(np.float32)]).astype(np.float32, copy=False)
