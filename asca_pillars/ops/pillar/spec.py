"""Spec of a pillar detector, shared by training, export and runtime; stored in `bundle.json`."""

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.geometry.boxes import Ranges
from asca_pillars.ops.pillar.grid import PillarGrid
from asca_pillars.ops.pillar.prepare import PillarLimits, Pillars, pillarize


@dataclass(frozen=True)
class PillarSpec(DetectorSpec):
    """Grid, input limits, classes and post-processing; the defaults are the paper's values.

    Attributes:
        grid: of the pillars.
        limits: caps on pillars and points.
        anchor_places: `cells`: anchors stand at the centers of the head map's cells; `ends`: evenly from one end of the
            range to the other, both included, as in OpenPCDet.
        anchor_scores: `own`: an anchor has one score, for its own class; `every`: one for every class, as in SECOND and
            OpenPCDet, and its box is of the class of the best.
    """

    grid: PillarGrid = field(default_factory=PillarGrid)
    limits: PillarLimits = field(default_factory=PillarLimits)
    anchor_places: Literal["cells", "ends"] = "cells"
    anchor_scores: Literal["own", "every"] = "own"

    @property
    def ranges(self) -> Ranges:
        """Detection ranges."""
        return self.grid.ranges

    def with_ranges(self, x_range_m: tuple[float, float], y_range_m: tuple[float, float]) -> "PillarSpec":
        """Return the spec with other ranges, metres, LiDAR frame; `max_pillars` grows with the area.

        Raises:
            ConfigError: pillars do not fill these ranges.
        """
        grid = replace(self.grid, x_range_m=x_range_m, y_range_m=y_range_m)
        growth = max(math.prod(grid.map_shape) / math.prod(self.grid.map_shape), 1.0)
        limits = replace(self.limits, max_pillars=math.ceil(self.limits.max_pillars * growth))
        return replace(self, grid=grid, limits=limits)

    def head_centers_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return centers of the head map's cells in metres, LiDAR frame: x of its columns (W,), y of its rows (H,)."""
        return self.grid.head_centers_m()

    def anchor_centers_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return anchor centers in metres, LiDAR frame: x of the head map's columns (W,), y of its rows (H,)."""
        if self.anchor_places == "cells":
            return self.head_centers_m()
        rows, columns = self.grid.head_shape
        return np.linspace(*self.grid.x_range_m, columns), np.linspace(*self.grid.y_range_m, rows)

    @property
    def scores_per_anchor(self) -> int:
        """Number of scores of each anchor."""
        return len(self.classes) if self.anchor_scores == "every" else 1

    def pillarize(self, points: NDArray[np.float32]) -> Pillars:
        """Return pillars of a scan (N, 4) in the LiDAR frame on this detector's grid, see `pillarize`."""
        return pillarize(points, self.grid, self.limits)
