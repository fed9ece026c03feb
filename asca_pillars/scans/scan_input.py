"""Reading of scan files by `ScanSettings`, with the mounting of their sensor."""

from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path

from asca_pillars.scans.ground_height import NamedPoints
from asca_pillars.scans.scan_reader import ReflectanceScale, Scan, read_scan
from asca_pillars.scans.scan_settings import ScanSettings, sample_points
from asca_pillars.scans.stored_scans import FolderScale, folder_reflectance_scale


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
