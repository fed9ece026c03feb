"""The active cells of one lattice, and the tables that convolutions between two of them read.

A lattice is made of columns: along z a cell is one bit of its column's 64-bit mask, so that a cell's row is the row
at which its column starts plus the number of bits set below it. No hash, no sort. Active cells are ordered by
(y, x, z), z running fastest, which makes every table and every network output independent of threads and machine.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.kernels import load_kernels
from asca_pillars.ops.sparse.convolution import Convolution, Links, Shape

KERNELS = "asca_pillars.ops.sparse.kernels"
MAX_Z_CELLS = 64  # the bits of a column's mask


class Columns(NamedTuple):
    """The lattice column by column, (ny * nx,) each."""

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
        columns = shape[1] * shape[2]
        masks = 0 if shape[0] == 1 else columns
        self.columns = Columns(np.zeros(masks, np.uint64), np.full(columns + 1, -1, np.int32))

    def __len__(self) -> int:
        return len(self.cells)

    def activate(self, cells: NDArray[np.int64]) -> None:
        """Make these cells (N,) the active ones: flat indices, ascending, none twice."""
        cells = np.ascontiguousarray(cells, np.int64)
        self._kernels.clear_columns(self.cells, self.shape[0], *self.columns)
        self._kernels.enter_cells(cells, self.shape[0], *self.columns)
        self.cells = cells

    def activate_points(self, cell_of_point: NDArray[np.int64]) -> None:
        """Make active the cells of these points (M,): flat indices in any order, -1 for none."""
        self._kernels.clear_columns(self.cells, self.shape[0], *self.columns)
        self._list_cells(self._kernels.mark_points(cell_of_point, self.shape[0], *self.columns))

    def activate_joined(self, sources: Sequence[tuple["CellMap", Links]]) -> None:
        """Make active what any tap joins with an active cell of any of the sources, none of which may be this map."""
        self._kernels.clear_columns(self.cells, self.shape[0], *self.columns)
        found = 0
        for source, links in sources:
            found += self._kernels.mark_joined(source.cells, *links, self.shape[2], *self.columns)
        self._list_cells(found)

    def _list_cells(self, count: int) -> None:
        """Make active what the kernels have marked, so many cells."""
        cells = np.empty(count + 1, np.int64)
        self._kernels.list_cells(*self.columns, self.shape[0], cells)
        self.cells = cells[:count]

    def table(self, source: "CellMap", links: Links) -> NDArray[np.int32]:
        """Index of the row in `source` that each tap joins with each active cell: (N, K), len(source) for none.

        With `Convolution.inputs` it is what the convolution from `source` to this map reads. With `outputs` it is
        the inverse that its backward pass reads: which output, of the map `source`, each input was read by.
        """
        table = np.empty((len(self.cells), math.prod(axis.shape[1] for axis in links)), np.int32)
        self._kernels.fill_table(self.cells, *links, source.shape[2], *source.columns, len(source), table)
        return table

    def places(self, parents: "CellMap", halvings: int) -> NDArray[np.int32]:
        """Row of each active cell of this map among the outputs of an upsampling that does not overlap.

        Seen from above (one cell along z). Each parent cell has s^2 outputs, s = 2^halvings, its row of them before
        the next parent's, (y, x) within the parent: (N,) int32, len(parents) * s^2 where the parent is not active.
        """
        missing = len(parents) << (2 * halvings)
        places = np.empty(len(self.cells), np.int32)
        self._kernels.fill_places(
            self.cells, self.shape[2], parents.shape[2], parents.columns.start, missing, halvings, places
        )
        return places


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
