"""Points -> pillars: the network's input (paper section 3.2), in training, export and on the vehicle.

Pillars are flat: the kept points of all pillars stand one after another, and `pillar_index` says whose each
is. Nothing is padded, so nothing needs to be masked later.
"""

import reprlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.kernels import load_kernels
from asca_pillars.base.strict import Strict
from asca_pillars.detection.decode import MOST
from asca_pillars.detection.report import ScanCounts
from asca_pillars.ops.pillar.grid import PillarGrid

KERNELS = "asca_pillars.ops.pillar.kernels"

FEATURES = ("x", "y", "z", "reflectance", "x_mean", "y_mean", "z_mean", "x_center", "y_center")
"""Channels of a point (D = 9 of the paper): position in metres, LiDAR frame; reflectance; offsets in metres
to the mean of the pillar's kept points and to the pillar's center."""


@dataclass(frozen=True)
class PillarLimits(Strict):
    """Upper bounds of one scan's input; beyond them an even subset is kept (P and N of the paper), see `evenly`."""

    max_pillars: int = 12000
    max_points: int = 64
    """Points of one pillar."""

    def __post_init__(self) -> None:
        for name in ("max_pillars", "max_points"):
            if not 1 <= getattr(self, name) <= MOST:
                raise ConfigError(f"{name} {reprlib.repr(getattr(self, name))} must lie between 1 and {MOST}")


@dataclass(frozen=True)
class PillarCounts(ScanCounts):
    """What became of a scan's points on the grid; points that are not finite count as outside."""

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
    sort, fill = (_sort_points, _fill_pillars) if kernels is None else (kernels.sort_points, kernels.fill_pillars)
    order, cells, counts = sort(points, grid)
    kept = evenly(np.arange(len(cells)), len(cells), limits.max_pillars)
    features, pillar_index, point_counts = fill(points, order, cells, counts, kept, limits.max_points, grid)
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


def evenly(places: NDArray[np.int64], counts: NDArray[np.int64] | int, most: int) -> NDArray[np.bool_]:
    """Whether what stands at these places, from 0, of rows of these counts stays, if `most` of a row may.

    What stays are even steps along the row: the share that random sampling would keep (paper section 3.2), of every
    part of the row alike, and a scan always gives the same.
    """
    stay = np.minimum(most, counts)
    return (places + 1) * stay // counts > places * stay // counts


def _sort_points(
    points: NDArray[np.float32], grid: PillarGrid
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Indices of the points inside, sorted by cell; the occupied cells, ascending; how many points each holds."""
    cell_of_point = grid.cells(points)
    order = np.flatnonzero(cell_of_point >= 0)
    order = order[_stable_argsort(cell_of_point[order])]
    starts = np.flatnonzero(np.diff(cell_of_point[order], prepend=-1))
    return order, cell_of_point[order[starts]], np.diff(starts, append=len(order))


def _stable_argsort(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """np.argsort(keys, kind="stable") for keys >= 0, several times faster.

    NumPy sorts 16-bit integers by radix, so one pass per 16-bit digit does it. Stable, hence the same on
    every machine, which NumPy's default sort is not.
    """
    order = np.arange(len(keys))
    for shift in range(0, int(keys.max(initial=0)).bit_length(), 16):
        digit = (keys[order] >> shift).astype(np.uint16)
        order = order[np.argsort(digit, kind="stable")]
    return order


def _fill_pillars(
    points: NDArray[np.float32],
    order: NDArray[np.int64],
    cells: NDArray[np.int64],
    counts: NDArray[np.int64],
    kept: NDArray[np.bool_],
    max_points: int,
    grid: PillarGrid,
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.int64]]:
    """Features (M, 9), pillar index (M,) and points per pillar (P,) of what is kept.

    Args:
        order: the points inside, sorted by pillar; `cells` (Q,) and `counts` (Q,) describe the pillars.
        kept: (Q,) which pillars stay.
    """
    pillar_of_point = np.repeat(np.arange(len(cells)), counts)
    stays = kept[pillar_of_point]
    starts = np.cumsum(counts) - counts
    stays &= evenly(np.arange(len(order)) - starts[pillar_of_point], counts[pillar_of_point], max_points)

    point_counts = np.minimum(counts[kept], max_points)
    features = _features(points.take(order[stays], axis=0), point_counts, grid.cell_centers_m(cells[kept]))
    return features, np.repeat(np.arange(len(point_counts)), point_counts), point_counts


def _features(
    points: NDArray[np.float32], counts: NDArray[np.int64], centers_m: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Points sorted by pillar (M, 4), points per pillar (P,) and pillar centers (P, 2) -> (M, 9)."""
    features = np.empty((len(points), len(FEATURES)), np.float32)
    pillar_index = np.repeat(np.arange(len(counts)), counts)
    # One channel at a time: NumPy is slow along an axis as short as the channels'.
    for channel in range(4):
        features[:, channel] = points[:, channel]
    for axis in range(3):
        # bincount sums in float64 and in order, so the mean does not depend on the machine.
        means = np.bincount(pillar_index, weights=points[:, axis], minlength=len(counts)) / counts
        features[:, 4 + axis] = points[:, axis] - np.repeat(means.astype(np.float32), counts)
    for axis in range(2):
        features[:, 7 + axis] = points[:, axis] - np.repeat(centers_m[:, axis], counts)
    return features
