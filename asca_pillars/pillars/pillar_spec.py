"""One pillar detector's numbers, all that training and the vehicle must agree on. `bundle.json` carries it."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.detector_spec import DetectorSpec
from asca_pillars.geometry.ranges import Ranges
from asca_pillars.pillars.grid import PillarGrid
from asca_pillars.pillars.pillarize import PillarLimits, Pillars, pillarize


@dataclass(frozen=True)
class PillarSpec(DetectorSpec):
    """Grid, input limits, classes and post-processing; the defaults are the paper's values."""

    grid: PillarGrid = field(default_factory=PillarGrid)
    limits: PillarLimits = field(default_factory=PillarLimits)

    @property
    def ranges(self) -> Ranges:
        """Where objects are looked for."""
        return self.grid.ranges

    def head_centers_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centers of the head map's cells in metres, LiDAR frame: x of its columns (W,), y of its rows (H,)."""
        return self.grid.head_centers_m()

    def pillarize(self, points: NDArray[np.float32], rng: np.random.Generator | None = None) -> Pillars:
        """Pillars of a scan (N, 4) in the LiDAR frame on this detector's grid, see `pillarize`."""
        return pillarize(points, self.grid, self.limits, rng)
