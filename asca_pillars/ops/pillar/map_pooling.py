"""Pillars of every zone gathered into a map of equally deep columns (`PillarGrid.map` = pooled).

A pillar of the first zone stands in two cells of the map, one of the second in its own; farther on several pillars
share a cell, and the largest value of each channel stays. An empty cell takes no part in that maximum: attention makes
features negative. Of one zone, and of the warped map, pillars and cells are the same.
"""

from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from asca_pillars.ops.pillar.grid import PillarGrid

Array = TypeVar("Array")
Value = TypeVar("Value", np.float32, np.uint8)


class MapCells(NamedTuple, Generic[Array]):
    """The M cells of the map that P pillars occupy."""

    cells: Array
    """(M,) flat index row * columns + column on the map, ascending."""
    pillars: Array
    """(E,) rows of the pillars of one cell after those of the other."""
    counts: Array
    """(M,) pillars of each cell, at least 1."""


def map_cells(cells: NDArray[np.int64], grid: PillarGrid) -> MapCells[NDArray[np.int64]] | None:
    """Where pillars at these cells (P,) of the grid, ascending, stand on the map; None where both are the same."""
    if not grid.pools:
        return None
    rows, columns = np.divmod(cells, grid.nx)
    copies = grid.map_copies[columns]
    pillars = np.repeat(np.arange(len(cells)), copies)
    first = np.repeat(rows * grid.map_shape[1] + grid.map_columns[columns], copies)
    place = (
        first + np.arange(len(pillars)) - np.repeat(np.cumsum(copies) - copies, copies)
    )  # ascending, as the cells are
    starts = np.flatnonzero(np.diff(place, prepend=-1))
    return MapCells(place[starts], pillars, np.diff(starts, append=len(place)))


def pool_pillars(
    features: NDArray[Value], cells: NDArray[np.int64], grid: PillarGrid
) -> tuple[NDArray[Value], NDArray[np.int64]]:
    """Features (P, C) of pillars at cells (P,) of the grid -> (M, C) and (M,) of the map.

    Steps of a quantized graph may be pooled as well: their order is that of the values.
    """
    found = map_cells(cells, grid)
    if found is None:
        return features, cells
    starts = np.cumsum(found.counts) - found.counts
    pooled = features[found.pillars[starts]]
    for further in range(1, int(found.counts.max(initial=1))):
        shared = np.flatnonzero(found.counts > further)
        pooled[shared] = np.maximum(pooled[shared], features[found.pillars[starts[shared] + further]])
    return pooled, found.cells
