"""The active cells of one lattice, and the tables that convolutions between two of them read.

A lattice is made of columns: along z a cell is one bit of its column's 64-bit mask, so that a cell's row is the row
at which its column starts plus the number of bits set below it. No hash, no sort. Active cells are ordered by
(y, x, z), z running fastest, which makes every table and every network output independent of threads and machine.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import product
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.kernels import load_kernels
from asca_pillars.ops.sparse.convolution import Convolution, Links, Shape

KERNELS = "asca_pillars.ops.sparse.kernels"
MAX_Z_CELLS = 64  # the bits of a column's mask


class Columns(NamedTuple):
    """The lattice column by column, (ny * nx,) each; in use only where numba runs the loops."""

    mask: NDArray[np.uint64]
    """Bit z: the cell is active. A lattice one cell high has none, and -1 as the start of a column without any."""
    start: NDArray[np.int32]
    """Row of the column's first active cell."""


class CellMap:
    """Which cells of a lattice are active; made once, its memory is kept from scan to scan.

    Changing the active cells clears only the columns that were in use.

    Args:
        shape: cells along z, y, x.

    Raises:
        ConfigError: more than MAX_Z_CELLS along z, or more cells in all than an int32 can number.
    """

    def __init__(self, shape: Shape) -> None:
        if min(shape) < 1 or shape[0] > MAX_Z_CELLS:
            raise ConfigError(
                f"a lattice of {shape[2]} x {shape[1]} x {shape[0]} cells: at least 1 along each axis and at most "
                f"{MAX_Z_CELLS} along z; choose taller cells or a smaller z range"
            )
        if np.prod(shape, dtype=np.int64) > np.iinfo(np.int32).max:
            raise ConfigError(
                f"a lattice of {shape[2]} x {shape[1]} x {shape[0]} cells: too many to number; choose larger ones"
            )
        self.shape = shape
        self.cells: NDArray[np.int64] = np.empty(0, np.int64)
        """(N,) active cells, flat index (y * nx + x) * nz + z, ascending."""
        self._kernels = load_kernels(KERNELS)
        self.columns: Any = None
        if self._kernels is not None:
            columns = shape[1] * shape[2]
            masks = 0 if shape[0] == 1 else columns
            self.columns = Columns(np.zeros(masks, np.uint64), np.full(columns + 1, -1, np.int32))

    def __len__(self) -> int:
        return len(self.cells)

    def activate(self, cells: NDArray[np.int64]) -> None:
        """Make these cells (N,) the active ones: flat indices, ascending, none twice."""
        cells = np.ascontiguousarray(cells, np.int64)
        if self._kernels is not None:
            self._kernels.clear_columns(self.cells, self.shape[0], *self.columns)
            self._kernels.enter_cells(cells, self.shape[0], *self.columns)
        self.cells = cells

    def activate_points(self, cell_of_point: NDArray[np.int64]) -> None:
        """Make active the cells of these points (M,): flat indices in any order, -1 for none."""
        if self._kernels is None:
            self.cells = np.unique(cell_of_point[cell_of_point >= 0])
            return
        self._kernels.clear_columns(self.cells, self.shape[0], *self.columns)
        self._list_cells(self._kernels, self._kernels.mark_points(cell_of_point, self.shape[0], *self.columns))

    def activate_joined(self, sources: Sequence[tuple["CellMap", Links]]) -> None:
        """Make active what any tap joins with an active cell of any of the sources, none of which may be this map."""
        if self._kernels is None:
            joined = [
                cells[joins] for source, links in sources for cells, joins in _taps(source.cells, links, self.shape)
            ]
            self.cells = np.unique(np.concatenate(joined))
            return
        self._kernels.clear_columns(self.cells, self.shape[0], *self.columns)
        found = 0
        for source, links in sources:
            found += self._kernels.mark_joined(source.cells, *links, self.shape[2], *self.columns)
        self._list_cells(self._kernels, found)

    def _list_cells(self, kernels: ModuleType, count: int) -> None:
        """Make active what the kernels have marked, so many cells."""
        cells = np.empty(count + 1, np.int64)
        kernels.list_cells(*self.columns, self.shape[0], cells)
        self.cells = cells[:count]

    def table(self, source: "CellMap", links: Links) -> NDArray[np.int32]:
        """Index of the row in `source` that each tap joins with each active cell: (N, K), len(source) for none.

        With `Convolution.inputs` it is what the convolution from `source` to this map reads. With `outputs` it is
        the inverse that its backward pass reads: which output, of the map `source`, each input was read by.
        """
        table = np.empty((len(self.cells), math.prod(axis.shape[1] for axis in links)), np.int32)
        if self._kernels is None:
            for tap, (cells, joins) in enumerate(_taps(self.cells, links, source.shape)):
                table[:, tap] = np.where(joins, _rows(source.cells, cells), len(source))
        else:
            self._kernels.fill_table(self.cells, *links, source.shape[2], *source.columns, len(source), table)
        return table

    def places(self, parents: "CellMap", halvings: int) -> NDArray[np.int32]:
        """Row of each active cell of this map among the outputs of an upsampling that does not overlap.

        Seen from above (one cell along z). Each parent cell has s^2 outputs, s = 2^halvings, its row of them before
        the next parent's, (y, x) within the parent: (N,) int32, len(parents) * s^2 where the parent is not active.
        """
        stride = 1 << halvings
        missing = len(parents) * stride**2
        if self._kernels is not None:
            places = np.empty(len(self.cells), np.int32)
            self._kernels.fill_places(
                self.cells, self.shape[2], parents.shape[2], parents.columns.start, missing, halvings, places
            )
            return places
        y, x = np.divmod(self.cells, self.shape[2])
        parent = _rows(parents.cells, y // stride * parents.shape[2] + x // stride)
        places = parent * stride**2 + y % stride * stride + x % stride
        return np.where(parent < len(parents), places, missing).astype(np.int32)


class Join(NamedTuple):
    """A convolution between two maps; made once, as they are, for scan after scan."""

    source: CellMap
    target: CellMap
    inputs: Links
    """From the cells of `target` to those of `source` that they read."""
    outputs: Links
    """From the cells of `source` to those of `target` that read them."""

    def table(self) -> NDArray[np.int32]:
        """What the convolution reads: (cells of `target`, K) rows of `source`, see `CellMap.table`."""
        return self.target.table(self.source, self.inputs)

    def inverse(self) -> NDArray[np.int32]:
        """What its backward pass reads: (cells of `source`, K) rows of `target`."""
        return self.source.table(self.target, self.outputs)


def join(convolution: Convolution, source: CellMap, target: CellMap) -> Join:
    """The convolution from one map to another."""
    inputs = convolution.inputs(target.shape, source.shape)
    return Join(source, target, inputs, convolution.outputs(source.shape, target.shape))


def _taps(
    cells: NDArray[np.int64], links: Links, other: Shape
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.bool_]]]:
    """Tap by tap: the cells of `other` that it joins with `cells`, and whether it joins them with any; (N,) both."""
    yx, z = np.divmod(cells, len(links.z))
    y, x = np.divmod(yx, len(links.x))
    for z_tap, y_tap, x_tap in product(links.z.T, links.y.T, links.x.T):
        other_z, other_y, other_x = z_tap[z], y_tap[y], x_tap[x]
        joins = (other_z >= 0) & (other_y >= 0) & (other_x >= 0)
        yield (other_y * other[2] + other_x) * other[0] + other_z, joins


def _rows(sorted_cells: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where each wanted cell stands among the sorted ones, len(sorted_cells) if it does not."""
    if not len(sorted_cells):
        return np.zeros(len(wanted), np.int64)
    rows = np.searchsorted(sorted_cells, wanted)
    found = sorted_cells[np.minimum(rows, len(sorted_cells) - 1)] == wanted
    return np.where(found, rows, len(sorted_cells))
