"""Rulebooks of sparse convolutions: geometry of a convolution, active cells of a lattice, kernel maps between lattices.

A lattice is made of columns: along z a cell is one bit of its column's 64-bit mask, so that a cell's row is the row at
which its column starts plus the number of bits set below it. This needs neither hashing nor sorting. Active cells are
ordered by (y, x, z), z running fastest, which makes every rulebook and every network output independent of threads and
machine.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.kernels import load_kernels

Shape = tuple[int, int, int]
"""Cells along z, y, x; a bird's-eye-view map has one along z."""


class AxisKernelMaps(NamedTuple):
    """Cells of two lattices that each tap of a convolution joins, per axis.

    Tap (kz, ky, kx) joins cell (z, y, x) with (maps.z[z, kz], maps.y[y, ky], maps.x[x, kx]), or with nothing where
    one of them is -1.
    """

    z: NDArray[np.int64]
    """(nz, kernel along z), as the other two along theirs."""
    y: NDArray[np.int64]
    x: NDArray[np.int64]


@dataclass(frozen=True)
class Convolution:
    """A convolution's geometry; tap (kz, ky, kx) is number (kz * kernel_y + ky) * kernel_x + kx, as PyTorch stores it.

    Raises:
        ConfigError: a size that is not positive, or a padding as large as the kernel.
    """

    kernel: Shape
    stride: Shape
    padding: Shape

    def __post_init__(self) -> None:
        for kernel, stride, padding in zip(self.kernel, self.stride, self.padding, strict=True):
            if kernel < 1 or stride < 1 or not 0 <= padding < kernel:
                raise ConfigError(
                    f"a convolution with kernel {self.kernel}, stride {self.stride} and padding {self.padding}: kernel "
                    "and stride must be at least 1, the padding less than the kernel"
                )

    def output_shape(self, shape: Shape) -> Shape:
        """Return the shape of the output for an input of this shape."""
        sizes = zip(shape, self.kernel, self.stride, self.padding, strict=True)
        z, y, x = ((size + 2 * padding - kernel) // stride + 1 for size, kernel, stride, padding in sizes)
        return z, y, x

    @property
    def taps(self) -> int:
        """Number of taps K of the kernel."""
        return math.prod(self.kernel)

    def inputs(self, outputs: Shape, inputs: Shape) -> AxisKernelMaps:
        """Return the kernel maps from an output cell to the input cells that it reads, on lattices of these shapes."""
        return _axis_kernel_maps(self, outputs, inputs, backward=False)

    def outputs(self, inputs: Shape, outputs: Shape) -> AxisKernelMaps:
        """Return the kernel maps from an input cell to the output cells that read it."""
        return _axis_kernel_maps(self, inputs, outputs, backward=True)


def map_convolution(kernel: int, stride: int = 1, padding: int = 0) -> Convolution:
    """Return a convolution on a bird's-eye-view map, of kernel size 1 along z."""
    return Convolution((1, kernel, kernel), (1, stride, stride), (0, padding, padding))


@lru_cache(maxsize=256)  # the same few for every map
def _axis_kernel_maps(convolution: Convolution, shape: Shape, other: Shape, *, backward: bool) -> AxisKernelMaps:
    axes = []
    for axis in range(3):
        taps, stride, padding = np.arange(convolution.kernel[axis]), convolution.stride[axis], convolution.padding[axis]
        places = np.arange(shape[axis])[:, None]
        joined, rest = np.divmod(places + padding - taps, stride) if backward else (places * stride - padding + taps, 0)
        exists = (rest == 0) & (joined >= 0) & (joined < other[axis])
        axes.append(np.where(exists, joined, -1))
        axes[-1].flags.writeable = False
    return AxisKernelMaps(*axes)


KERNELS = "asca_pillars.ops.sparse.kernels"
MAX_Z_CELLS = 64  # the bits of a column's mask


class Columns(NamedTuple):
    """The lattice column by column, (ny * nx,) each."""

    mask: NDArray[np.uint64]
    """Bit z: the cell is active. A lattice one cell high has none, and -1 as the start of a column without any."""
    start: NDArray[np.int32]
    """Row of the column's first active cell."""


class CellMap:
    """Active cells of a lattice; made once, its memory is reused from scan to scan.

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

    def activate_joined(self, sources: Sequence[tuple["CellMap", AxisKernelMaps]]) -> None:
        """Activate the cells that any tap joins with an active cell of a source; this map must not be a source."""
        self._kernels.clear_columns(self.cells, self.shape[0], *self.columns)
        active = 0
        for source, kernel_maps in sources:
            active += self._kernels.mark_joined(source.cells, *kernel_maps, self.shape[2], *self.columns)
        self._list_cells(active)

    def _list_cells(self, count: int) -> None:
        """Activate the cells that the kernels have marked, of this number."""
        cells = np.empty(count + 1, np.int64)
        self._kernels.list_cells(*self.columns, self.shape[0], cells)
        self.cells = cells[:count]

    def rulebook(self, source: "CellMap", kernel_maps: AxisKernelMaps) -> NDArray[np.int32]:
        """Return the row in `source` that each tap joins with each active cell: (N, K), len(source) for none.

        With `Convolution.inputs` it is the rulebook of the convolution from `source` to this map. With `outputs` it is
        the inverse for the backward pass: the output, on the map `source`, that read each input.
        """
        rulebook = np.empty((len(self.cells), math.prod(axis.shape[1] for axis in kernel_maps)), np.int32)
        self._kernels.fill_rulebook(self.cells, *kernel_maps, source.shape[2], *source.columns, len(source), rulebook)
        return rulebook

    def places(self, parents: "CellMap", halvings: int) -> NDArray[np.int32]:
        """Return the row of each active cell of this map among the outputs of a non-overlapping upsampling.

        For lattices one cell high. Each parent cell has s^2 outputs, s = 2^halvings, its row of them before the next
        parent's, (y, x) within the parent: (N,) int32, len(parents) * s^2 where the parent is not active.
        """
        missing = len(parents) << (2 * halvings)
        places = np.empty(len(self.cells), np.int32)
        self._kernels.fill_places(
            self.cells, self.shape[2], parents.shape[2], parents.columns.start, missing, halvings, places
        )
        return places


class KernelMap(NamedTuple):
    """Convolution between two maps; made once for scan after scan."""

    source: CellMap
    target: CellMap
    inputs: AxisKernelMaps
    """From the cells of `target` to the cells of `source` that they read."""
    outputs: AxisKernelMaps
    """From the cells of `source` to the cells of `target` that read them."""

    def rulebook(self) -> NDArray[np.int32]:
        """Return the rulebook of the convolution: (cells of `target`, K) rows of `source`, see `CellMap.rulebook`."""
        return self.target.rulebook(self.source, self.inputs)

    def inverse(self) -> NDArray[np.int32]:
        """Return the rulebook of the backward pass: (cells of `source`, K) rows of `target`."""
        return self.source.rulebook(self.target, self.outputs)


def build_kernel_map(convolution: Convolution, source: CellMap, target: CellMap) -> KernelMap:
    """Return the kernel map of a convolution between two cell maps."""
    inputs = convolution.inputs(target.shape, source.shape)
    return KernelMap(source, target, inputs, convolution.outputs(source.shape, target.shape))


def stack_rows(rulebooks: Sequence[NDArray[np.int32]], rows: Sequence[int]) -> NDArray[np.int32]:
    """Stack rulebooks (M_i, ...) of indices into features of `rows[i]` rows -> one into all of them, (sum of M_i, ...).

    The index of a missing row, rows[i], becomes sum(rows).
    """
    starts, total = np.concatenate([[0], np.cumsum(rows)]).astype(np.int32), sum(rows)
    moved = [
        np.where(rulebook == count, np.int32(total), rulebook + start)
        for rulebook, count, start in zip(rulebooks, rows, starts[:-1], strict=True)
    ]
    return np.concatenate(moved)


def stack_cells(cells: Sequence[NDArray[np.int32]], cells_per_frame: int) -> NDArray[np.int32]:
    """Stack flat indices (M_i,) on each frame's map -> (sum of M_i,) on the maps of all frames, one after the other."""
    return np.concatenate([frame_cells + np.int32(frame * cells_per_frame) for frame, frame_cells in enumerate(cells)])
