"""What a sparse neck reads: the active cells of its three levels, and a table for each of its convolutions.

The neck is that of Table 1 (three blocks that halve the map, three upsamplings to the head's resolution), computed at
active cells alone. Which cells are active is a rule:

- `sub`: strided convolutions reach every output that sees an active input, all others stay where their input is;
- `fine`: as `sub`, and the first stride-1 convolution of the finest block also writes to the eight neighbors of its
  active cells. The coarser levels follow from the cells before that growth.

The head computes at the union of the three levels' cells, as it sees it: where a coarser cell is active, so are the
head cells below it.
"""

import math
from collections.abc import Sequence
from typing import Generic, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from asca_pillars.ops.sparse.rulebooks import CellMap, join, map_convolution, stack_cells, stack_rows

MaskRule = Literal["sub", "fine"]

LEVELS = 3
STRIDED = map_convolution(3, stride=2, padding=1)
SAME = map_convolution(3, padding=1)
_NO_TABLE = np.empty((0, SAME.taps), np.int32)

Array = TypeVar("Array")


class LevelTables(NamedTuple, Generic[Array]):
    """One block of the neck; M cells after its strided convolution, N after its first stride-1 convolution."""

    strided: Array
    """(M, 9) rows of the level before; of the pillars for the first."""
    first: Array
    """(N, 9) rows of the strided convolution's outputs; the same as `same` where nothing grows."""
    same: Array
    """(N, 9) rows of the N cells themselves."""
    strided_back: Array
    """(rows of the level before, 9) the inverse of `strided`, for training; empty without."""
    first_back: Array
    """(M, 9) the inverse of `first`, for training; empty without."""
    strided_cells: Array
    """(M,) flat index row * columns + column on this level's map, ascending."""
    cells: Array
    """(N,) likewise, of the block's outputs."""
    places: Array
    """(head cells,) rows of the upsampling's outputs, see `CellMap.places`."""


class NeckTables(NamedTuple, Generic[Array]):
    """Of one scan (NumPy), or of a batch (tensors), whose rows follow one another frame by frame."""

    levels: tuple[LevelTables[Array], ...]
    """From the finest to the coarsest."""
    head_cells: Array
    """(H,) flat index of the active cells on the head's map, of a batch counted through the maps of its frames."""
    frame_rows: tuple[int, ...]
    """Active head cells of each frame."""
    map_shape: tuple[int, int]
    """(rows, columns) of one frame's head map."""


class NeckTableBuilder:
    """Builds the tables of scan after scan, in memory of its own: for one thread at a time.

    Args:
        ny, nx: pillars of the map, multiples of 8.
        rule: which cells are active.
        training: also the tables that the backward pass reads.
    """

    def __init__(self, ny: int, nx: int, rule: MaskRule, *, training: bool = False) -> None:
        self.rule: MaskRule = rule
        self.training = training
        shapes = [(1, ny >> level, nx >> level) for level in range(LEVELS + 1)]
        self._pillars, *self._strided = (CellMap(shape) for shape in shapes)
        self._outputs = list(self._strided)
        if rule == "fine":
            self._outputs[0] = CellMap(shapes[1])
        self._head = CellMap(shapes[1])
        before = [self._pillars, *self._outputs[:-1]]
        self._halvings = [join(STRIDED, *maps) for maps in zip(before, self._strided, strict=True)]
        self._growths = [join(SAME, *maps) for maps in zip(self._strided, self._outputs, strict=True)]
        self._stays = [join(SAME, level, level) for level in self._outputs]
        strides = [map_convolution(1 << level, stride=1 << level) for level in range(LEVELS)]
        self._children = [join(stride, self._head, level) for stride, level in zip(strides, self._outputs, strict=True)]

    def build(self, cells: NDArray[np.int64]) -> NeckTables[NDArray[np.int32]]:
        """Tables of a scan with pillars at these cells (P,): flat indices row * nx + column, ascending."""
        self._activate(cells)
        levels = []
        for number in range(LEVELS):
            halving, growth, stay = self._halvings[number], self._growths[number], self._stays[number]
            strided, output = growth.source, growth.target
            same = stay.table()
            levels.append(
                LevelTables(
                    strided=halving.table(),
                    first=same if strided is output else growth.table(),
                    same=same,
                    strided_back=halving.inverse() if self.training else _NO_TABLE,
                    first_back=growth.inverse() if self.training else _NO_TABLE,
                    strided_cells=strided.cells.astype(np.int32),
                    cells=output.cells.astype(np.int32),
                    places=self._head.places(output, number),
                )
            )
        return NeckTables(tuple(levels), self._head.cells.astype(np.int32), (len(self._head),), self._head.shape[1:])

    def _activate(self, cells: NDArray[np.int64]) -> None:
        """Find the active cells of every map, as the rule says."""
        self._pillars.activate(cells)
        before = self._pillars
        for halving, level in zip(self._halvings, self._strided, strict=True):
            level.activate_joined([(before, halving.outputs)])  # the coarser levels do not see the growth
            before = level
        if self.rule == "fine":
            growth = self._growths[0]
            growth.target.activate_joined([(growth.source, growth.outputs)])
        self._head.activate_joined([(children.target, children.inputs) for children in self._children])


def stack_neck_tables(
    frames: Sequence[NeckTables[NDArray[np.int32]]], pillars: Sequence[int]
) -> NeckTables[NDArray[np.int32]]:
    """Tables of a batch from those of its frames.

    Args:
        frames: at least one, all of one map; indices (M, 9) or (M,).
        pillars: how many each frame has.
    """
    levels, before = [], list(pillars)
    map_cells = math.prod(frames[0].map_shape)
    for number in range(LEVELS):
        parts = [frame.levels[number] for frame in frames]
        strided = [len(part.strided_cells) for part in parts]
        outputs = [len(part.cells) for part in parts]
        levels.append(
            LevelTables(
                strided=stack_rows([part.strided for part in parts], before),
                first=stack_rows([part.first for part in parts], strided),
                same=stack_rows([part.same for part in parts], outputs),
                strided_back=stack_rows([part.strided_back for part in parts], strided),
                first_back=stack_rows([part.first_back for part in parts], outputs),
                strided_cells=stack_cells([part.strided_cells for part in parts], map_cells >> (2 * number)),
                cells=stack_cells([part.cells for part in parts], map_cells >> (2 * number)),
                places=stack_rows([part.places for part in parts], [count << (2 * number) for count in outputs]),
            )
        )
        before = outputs
    return NeckTables(
        tuple(levels),
        stack_cells([frame.head_cells for frame in frames], map_cells),
        tuple(len(frame.head_cells) for frame in frames),
        frames[0].map_shape,
    )


def table_inputs(tables: NeckTables[Array]) -> dict[str, Array]:
    """What a graph of the neck can ask for, by the names of its inputs; it takes what its layers read."""
    return {
        f"{kind}_{number}": getattr(level, kind)
        for number, level in enumerate(tables.levels)
        for kind in ("strided", "first", "same", "places")
    }
