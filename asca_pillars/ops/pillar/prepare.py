"""Pillarization: the network's input from points (paper section 3.2), for training, export and runtime.

Pillars are flat: the kept points of all pillars follow one another, and `pillar_index` holds the pillar of each point.
There is no padding, and no masking later.
"""

import reprlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.kernels import load_kernels
from asca_pillars.base.strict import Strict
from asca_pillars.detection.decode import MOST
from asca_pillars.detection.detections import ScanCounts
from asca_pillars.ops.pillar.grid import PillarGrid

KERNELS = "asca_pillars.ops.pillar.kernels"

FEATURES = ("x", "y", "z", "reflectance", "x_mean", "y_mean", "z_mean", "x_center", "y_center")
"""Channels of a point (D = 9 of the paper): position in metres, LiDAR frame; reflectance; offsets in metres
to the mean of the pillar's kept points and to the pillar's center."""


@dataclass(frozen=True)
class PillarLimits(Strict):
    """Upper bounds of one scan; beyond them an even subset is kept (P and N of the paper), see `evenly_spaced_mask`."""

    max_pillars: int = 12000
    max_points: int = 64
    """Points of one pillar."""

    def __post_init__(self) -> None:
        for name in ("max_pillars", "max_points"):
            if not 1 <= getattr(self, name) <= MOST:
                raise ConfigError(f"{name} {reprlib.repr(getattr(self, name))} must lie between 1 and {MOST}")


@dataclass(frozen=True)
class PillarCounts(ScanCounts):
    """Counts of a scan's points on the grid; points that are not finite count as outside."""

    pillars: int
    """Pillars kept."""
    pillars_over_limit: int
    """Pillars that hold points but were dropped."""


@dataclass(frozen=True, eq=False)
class Pillars:
    """The pillars of one scan: M kept points in P pillars, both in flat-index order of the pillars.

    Within a pillar the points keep the order of the scan.
    """

    features: NDArray[np.float32]
    """(M, 9), channels as in FEATURES."""
    pillar_index: NDArray[np.int64]
    """(M,) the pillar 0..P-1 of each point, non-decreasing."""
    point_counts: NDArray[np.int64]
    """(P,) kept points of each pillar, at least 1."""
    cells: NDArray[np.int64]
    """(P,) flat grid index row * nx + column of each pillar, ascending."""
    stats: PillarCounts


def pillarize(
    points: NDArray[np.float32],
    grid: PillarGrid,
    limits: PillarLimits,
) -> Pillars:
    """Sort a scan's points into pillars and compute their nine features (paper section 3.2).

    Args:
        points: (N, 4) float32 x, y, z in metres (LiDAR frame) and reflectance in [0, 1]; N may be 0.

    Raises:
        ValueError: if `points` is not (N, 4).
    """
    if points.ndim != 2 or points.shape[1] != 4:
        raise ValueError(f"points must have shape (N, 4), not {points.shape}")
    points = np.require(points, np.float32, ["C", "ALIGNED"])
    kernels = load_kernels(KERNELS)
    order, cells, counts = kernels.sort_points(points, grid)
    kept = evenly_spaced_mask(np.arange(len(cells)), len(cells), limits.max_pillars)
    features, pillar_index, point_counts = kernels.fill_pillars(
        points, order, cells, counts, kept, limits.max_points, grid
    )
    return Pillars(
        features=features,
        pillar_index=pillar_index,
        point_counts=point_counts,
        cells=cells[kept],
        stats=PillarCounts(
            points=len(points),
            points_outside=len(points) - len(order),
            points_over_limit=len(order) - len(features),
            pillars=len(point_counts),
            pillars_over_limit=len(cells) - len(point_counts),
        ),
    )


def evenly_spaced_mask(places: NDArray[np.int64], counts: NDArray[np.int64] | int, most: int) -> NDArray[np.bool_]:
    """Return a mask of the entries kept if a row may keep `most`: positions in the rows, from 0, and the rows' lengths.

    Kept entries are evenly spaced along the row: the share that random sampling keeps (paper section 3.2), taken from
    every part of the row alike and without randomness.
    """
    stay = np.minimum(most, counts)
    return (places + 1) * stay // counts > places * stay // counts
