"""Scan files as the options of a command want them read, and the mounting of their sensor."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from asca_pillars.commands.options import ScanOptions
from asca_pillars.data.ground_height import measured_mounting
from asca_pillars.data.mounting import Mounting, read_pose
from asca_pillars.data.scans.reflectance import ReflectanceScale, checked_scale
from asca_pillars.data.scans.scan_reader import FolderScale, Scan, folder_reflectance_scale, read_scan
from asca_pillars.errors import ConfigError, ScanError

HEIGHT_SCANS = 8  # that `--sensor-height auto` looks at


class ScanInput:
    """Reads scans; the reflectance scale of each folder and suffix is decided once.

    Attributes:
        mounting: of the sensor.
        said: sentences about what was decided, for the user.

    Raises:
        ConfigError, ScanError: an option cannot be used, or the height not be estimated.
    """

    def __init__(self, options: ScanOptions, paths: Sequence[Path]) -> None:
        self._columns = options.columns
        self._scales: dict[tuple[Path, str], FolderScale] = {}
        self.said: list[str] = []
        stated = stated_scale(options)
        for key, group in groupby(sorted(paths, key=_folder_and_suffix), _folder_and_suffix):
            self._scales[key] = self._decide(key[0], list(group)) if stated == "auto" else FolderScale(stated, None)
        chosen = paths[:: max(-(-len(paths) // HEIGHT_SCANS), 1)]
        self.mounting, said = stated_mounting(options, lambda: self._readable(chosen))
        self.said += said

    def read(self, path: Path) -> Scan:
        """One of the scans.

        Raises:
            ScanError: as `read_scan`.
        """
        return read_scan(path, columns=self._columns, reflectance_scale=self._scales[_folder_and_suffix(path)].scale)

    def _decide(self, folder: Path, paths: list[Path]) -> FolderScale:
        where = folder if len(paths) > 1 else paths[0]
        decided = folder_reflectance_scale(paths, columns=self._columns)
        self.said += [f"{where}: {line}" for line in said_of_scale(decided)]
        return decided

    def _readable(self, paths: Iterable[Path]) -> Iterator[NDArray[np.float32]]:
        for path in paths:
            try:
                yield self.read(path).points
            except ScanError:
                continue  # named when its turn comes


def stated_scale(options: ScanOptions) -> ReflectanceScale:
    """The reflectance scale as typed; ScanError or ConfigError if it is none."""
    return checked_scale(_number(options.reflectance_scale, "--reflectance-scale"))


def said_of_scale(decided: FolderScale) -> list[str]:
    """What a user is to know of a scale that the values decided: a sentence, or none."""
    if decided.scale in (1.0, "auto"):
        return []
    return [decided.doubt or f"reflectances were taken as 0..{decided.scale:g} (--reflectance-scale {decided.scale:g})"]


def stated_mounting(
    options: ScanOptions, sample: Callable[[], Iterable[NDArray[np.float32]]]
) -> tuple[Mounting, list[str]]:
    """The mounting as typed, and sentences for the user.

    Args:
        options: as typed.
        sample: points (N, 4) in metres of some scans, for a height that is to be estimated.

    Raises:
        ConfigError, ScanError: an option cannot be used, or the height not be estimated.
    """
    pose = None if options.pose is None else read_pose(options.pose)
    height = None if options.sensor_height is None else _number(options.sensor_height, "--sensor-height")
    if height != "auto":
        return Mounting(height, options.axes, pose), []
    mounting, estimate = measured_mounting(sample(), Mounting(None, options.axes, pose))
    return mounting, [f"sensor height: {estimate}"]


def _folder_and_suffix(path: Path) -> tuple[Path, str]:
    return path.parent, path.suffix.lower()


def _number(text: str, option: str) -> Literal["auto"] | float:
    if text == "auto":
        return "auto"
    try:
        return float(text)
    except ValueError:
        raise ConfigError(f"{option} {text[:40]}: give a number or auto") from None
