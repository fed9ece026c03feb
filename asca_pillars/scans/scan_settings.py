"""Settings of scan reading and sensor mounting, and the reading of scan files by them.

The options of commands and the keys of a dataset.yaml share the settings. Scans of one source have one reflectance
scale.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import groupby
from math import inf
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError, ScanError
from asca_pillars.base.strict import Strict
from asca_pillars.scans.find_scans import evenly_spaced
from asca_pillars.scans.ground_height import HeightEstimate, NamedPoints, estimate_named_height
from asca_pillars.scans.mounting import Mounting, read_pose, refuse_axes_with_pose
from asca_pillars.scans.records import StoredPoints
from asca_pillars.scans.scan_reader import ReflectanceScale, Scan, ambiguity, decide_scale, read_scan, read_stored

FEWEST_COLUMNS = 3
SAMPLE_SCANS = 8  # with visible ground: a height of "auto" is their median
SEARCHED_SCANS = 32  # that are searched for them


@dataclass(frozen=True)
class ScanSettings(Strict):
    """Properties that a scan file does not state itself.

    Attributes:
        sensor_height: metres above the ground of the scans' origin, after `axes` or `pose`; "auto": estimated from the
            scans. None: the height of the training scans.
        axes: as `Mounting.axes`.
        pose: file with a 4x4 matrix, instead of axes (`mounting.read_pose`).
        reflectance_scale: the stored value that is a reflectance of 1; "auto": decided by the values.
        columns: float32 values per point of a .bin; None: four or five, decided by the values.

    Raises:
        ConfigError: a value that cannot be used.
    """

    sensor_height: float | Literal["auto"] | None = None
    axes: str = "x-forward"
    pose: str | None = None
    reflectance_scale: ReflectanceScale = "auto"
    columns: int | None = None

    def __post_init__(self) -> None:
        Mounting(self._stated_height_m, self.axes)  # validates the values
        if self.pose is not None:
            refuse_axes_with_pose(self.axes)
        if self.columns is not None and self.columns < FEWEST_COLUMNS:
            raise ConfigError(f"columns {self.columns}: a .bin has at least x, y and z; give {FEWEST_COLUMNS} or more")
        if self.reflectance_scale != "auto" and not 0 < self.reflectance_scale < inf:
            raise ConfigError(f"reflectance_scale {self.reflectance_scale:g}: must be positive, such as 255, or auto")

    def stated_mounting(self, folder: Path | None = None) -> Mounting:
        """Return the mounting as far as it is stated: an "auto" height is None.

        Args:
            folder: base of a relative `pose`; None: the working directory.

        Raises:
            ConfigError: the pose cannot be read, or does not go with the axes.
        """
        pose = None if self.pose is None else read_pose((folder or Path()) / self.pose)
        return Mounting(self._stated_height_m, self.axes, pose)

    def mounting(
        self, samples: Iterable[NamedPoints], folder: Path | None = None
    ) -> tuple[Mounting, HeightEstimate | None]:
        """Return the mounting, and the estimate of a height of "auto"; None if it was stated.

        Args:
            samples: some scans; only read if the height is "auto", until enough of them show the ground.
            folder: as for `stated_mounting`.

        Raises:
            ConfigError: as `stated_mounting`.
            ScanError: the height cannot be estimated.
        """
        stated = self.stated_mounting(folder)
        if self.sensor_height != "auto":
            return stated, None
        estimate = estimate_named_height(samples, stated, SAMPLE_SCANS)
        return replace(stated, sensor_height_m=estimate.height_m), estimate

    @property
    def _stated_height_m(self) -> float | None:
        return None if self.sensor_height == "auto" else self.sensor_height


def sample_points(paths: Sequence[Path], read: Callable[[Path], NDArray[np.float32]]) -> Iterator[NamedPoints]:
    """Yield up to SEARCHED_SCANS readable scans with points: SAMPLE_SCANS evenly spaced ones, then those between.

    Args:
        paths: paths of all scans.
        read: points (N, >=3), metres, of one of them; ScanError if it cannot be read.
    """
    step = max(-(-len(paths) // SAMPLE_SCANS), 1)
    order = [path for first in range(step) for path in paths[first::step]]
    for path in order[:SEARCHED_SCANS]:
        try:
            points = read(path)
        except ScanError:
            continue  # reported when it is read
        if len(points):
            yield NamedPoints(str(path), points)


class FolderScale(NamedTuple):
    """Reflectance scale of scans of the same source, and the reason why it may be wrong, if any."""

    scale: ReflectanceScale
    doubt: str | None


def folder_reflectance_scale(paths: Sequence[Path], *, columns: int | None = None, sample: int = 16) -> FolderScale:
    """Return one reflectance scale for scans of the same source, from `sample` of them, evenly spaced.

    A dark scan among brighter ones is then read on the same scale. Scans that cannot be read, or have no points,
    are ignored; where none has reflectances, the scale is auto.
    """
    stored = []
    for path in evenly_spaced(paths, sample):
        with suppress(ScanError):
            stored.append(read_stored(path, columns))
    return common_reflectance_scale(stored)


def common_reflectance_scale(stored: Sequence[StoredPoints]) -> FolderScale:
    """Return one reflectance scale for scans of the same source: the largest scale of any of them.

    Auto where none of them has reflectances; scans without points are ignored.
    """
    samples = [
        (scan.reflectance, scan.dtype) for scan in stored if scan.reflectance is not None and has_finite_point(scan)
    ]
    if not samples:
        return FolderScale("auto", None)
    decided = [decide_scale(*scan) for scan in samples]
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


class ScanInput:
    """Reader of scans; the reflectance scale of each folder and suffix is decided once.

    Attributes:
        paths: of the scans.
        mounting: mounting of the sensor.
        notes: sentences for the user about the settings that were chosen.

    Raises:
        ConfigError, ScanError: an option cannot be used, or the height cannot be estimated.
    """

    def __init__(self, settings: ScanSettings, paths: Sequence[Path]) -> None:
        self._columns = settings.columns
        self.paths = paths
        self._scales: dict[tuple[Path, str], FolderScale] = {}
        self.notes: list[str] = []
        stated = settings.reflectance_scale
        for key, group in groupby(sorted(paths, key=_folder_and_suffix), _folder_and_suffix):
            self._scales[key] = self._decide(key[0], list(group)) if stated == "auto" else FolderScale(stated, None)
        self.mounting, estimate = settings.mounting(self.samples())
        if estimate is not None:
            self.notes.append(f"sensor height: {estimate}")

    def read(self, path: Path) -> Scan:
        """Read one of the scans.

        Raises:
            ScanError: as `read_scan`.
        """
        return read_scan(path, columns=self._columns, reflectance_scale=self.scale(path))

    def samples(self) -> Iterator[NamedPoints]:
        """Yield some of the scans, see `sample_points`."""
        return sample_points(self.paths, lambda path: self.read(path).points)

    def scale(self, path: Path) -> ReflectanceScale:
        """Return the reflectance scale of one of the scans."""
        return self._scales[_folder_and_suffix(path)].scale

    def _decide(self, folder: Path, paths: list[Path]) -> FolderScale:
        where = folder if len(paths) > 1 else paths[0]
        decided = folder_reflectance_scale(paths, columns=self._columns)
        self.notes += [f"{where}: {line}" for line in scale_notes(decided)]
        return decided


def scale_notes(decided: FolderScale) -> list[str]:
    """Return a sentence for the user about a scale that was decided by the values, or none."""
    if decided.scale in (1.0, "auto"):
        return []
    return [decided.doubt or f"reflectances were taken as 0..{decided.scale:g} (--reflectance-scale {decided.scale:g})"]


def _folder_and_suffix(path: Path) -> tuple[Path, str]:
    return path.parent, path.suffix.lower()
