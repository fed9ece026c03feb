"""Points -> pillars: the network's input (paper section 3.2), in training, export and on the vehicle.

Pillars are flat: the kept points of all pillars stand one after another, and `pillar_index` says whose each
is. Nothing is padded, so nothing needs to be masked later.
"""

import zlib
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from asca_pillars.errors import ConfigError
from asca_pillars.geometry.grid import PillarGrid

FEATURES = ("x", "y", "z", "reflectance", "x_mean", "y_mean", "z_mean", "x_center", "y_center")
"""Channels of a point (D = 9 of the paper): position in metres, LiDAR frame; reflectance; offsets in metres
to the mean of the pillar's kept points and to the pillar's centre."""


@dataclass(frozen=True)
class PillarLimits:
    """Upper bounds of one scan's input; a random subset is kept beyond them (P and N of the paper)."""

    max_pillars: int = 12000
    max_points: int = 64
    """Points of one pillar."""

    __pydantic_config__: ClassVar[dict[str, str]] = {"extra": "forbid"}

    def __post_init__(self) -> None:
        for name in ("max_pillars", "max_points"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} {getattr(self, name)} must be at least 1")


@dataclass(frozen=True)
class PillarCounts:
    """What became of a scan's points: points = kept + points_outside + points_over_limit."""

    points: int
    """Points of the scan."""
    points_outside: int
    """Points outside the grid's ranges, or not finite."""
    points_over_limit: int
    """Points inside that either limit dropped."""
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
    rng: np.random.Generator | None = None,
) -> Pillars:
    """Sort a scan's points into pillars and compute their nine features (paper section 3.2).

    Args:
        points: (N, 4) float32 x, y, z in metres (LiDAR frame) and reflectance in [0, 1]; N may be 0.
        rng: draws the subset kept beyond the limits. None seeds the draw by the points themselves, so that a
            scan always gives the same pillars; training passes a generator.

    Raises:
        ValueError: if `points` is not (N, 4).
    """
    if points.ndim != 2 or points.shape[1] != 4:
        raise ValueError(f"points must have shape (N, 4), not {points.shape}")
    points = np.ascontiguousarray(points, np.float32)
    cells = grid.cells(points)
    order = np.flatnonzero(cells >= 0)
    order = order[_stable_argsort(cells[order])]
    cell_of_point = cells[order]
    inside = len(order)
    starts = np.flatnonzero(np.diff(cell_of_point, prepend=-1))
    counts = np.diff(starts, append=inside)
    found = len(starts)

    if found > limits.max_pillars or counts.max(initial=0) > limits.max_points:
        if rng is None:
            rng = np.random.default_rng(zlib.crc32(points.data))
        keep = _draw(counts, limits, rng)
        order, cell_of_point = order[keep], cell_of_point[keep]
        starts = np.flatnonzero(np.diff(cell_of_point, prepend=-1))
        counts = np.diff(starts, append=len(order))

    cells = cell_of_point[starts]
    return Pillars(
        features=_features(points.take(order, axis=0), counts, grid.cell_centres_m(cells)),
        pillar_index=np.repeat(np.arange(len(cells), dtype=np.int64), counts),
        point_counts=counts,
        cells=cells,
        stats=PillarCounts(
            points=len(points),
            points_outside=len(points) - inside,
            points_over_limit=inside - len(order),
            pillars=len(cells),
            pillars_over_limit=found - len(cells),
        ),
    )


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


def _draw(counts: NDArray[np.int64], limits: PillarLimits, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which of the sorted points to keep, given the points per pillar: (M,) bool."""
    kept_pillars = np.ones(len(counts), bool)
    kept_pillars[rng.permutation(len(counts))[limits.max_pillars :]] = False
    keep = np.repeat(kept_pillars, counts)

    # The points of crowded pillars, shuffled and then sorted by pillar: in each pillar the first ones stay.
    crowded = kept_pillars & (counts > limits.max_points)
    shuffled = rng.permutation(np.flatnonzero(np.repeat(crowded, counts)))
    pillar_index = np.repeat(np.arange(len(counts)), counts)
    shuffled = shuffled[_stable_argsort(pillar_index[shuffled])]
    first = np.cumsum(counts[crowded]) - counts[crowded]
    rank = np.arange(len(shuffled)) - np.repeat(first, counts[crowded])
    keep[shuffled[rank >= limits.max_points]] = False
    return keep


def _features(
    points: NDArray[np.float32], counts: NDArray[np.int64], centres_m: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Points sorted by pillar (M, 4), points per pillar (P,) and pillar centres (P, 2) -> (M, 9)."""
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
        features[:, 7 + axis] = points[:, axis] - np.repeat(centres_m[:, axis], counts)
    return features
