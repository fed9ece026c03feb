"""Settings of scan reading and sensor mounting, shared by the options of commands and the keys of a dataset.yaml."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError, ScanError
from asca_pillars.base.strict import Strict
from asca_pillars.scans.ground_height import HeightEstimate, NamedPoints, estimate_named_height
from asca_pillars.scans.mounting import Mounting, read_pose, refuse_axes_with_pose
from asca_pillars.scans.scan_reader import ReflectanceScale

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
