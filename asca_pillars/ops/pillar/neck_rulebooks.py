"""Input of a sparse neck: the active cells of its three levels, and a rulebook for each of its convolutions.

The neck is that of Table 1 (three blocks that halve the map, three upsamplings to the head's resolution), computed at
active cells alone. Which cells are active is a rule:

- `sub`: strided convolutions are regular (every output with an active input), all others are submanifold;
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

from asca_pillars.ops.sparse.rulebooks import CellMap, build_kernel_map, map_convolution, stack_cells, stack_rows

MaskRule = Literal["sub", "fine"]

LEVELS = 3
STRIDED = map_convolution(3, stride=2, padding=1)
SAME = map_convolution(3, padding=1)
_NO_RULEBOOK = np.empty((0, SAME.taps), np.int32)

Array = TypeVar("Array")


class LevelRulebooks(NamedTuple, Generic[Array]):
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


class NeckRulebooks(NamedTuple, Generic[Array]):
    """Rulebooks of the neck for one scan (NumPy), or for a batch (tensors), whose rows follow frame by frame."""

    levels: tuple[LevelRulebooks[Array], ...]
    """Levels from the finest to the coarsest."""
    head_cells: Array
    """(H,) flat index of the active cells on the head's map, of a batch counted through the maps of its frames."""
    frame_rows: tuple[int, ...]
    """Active head cells of each frame."""
    map_shape: tuple[int, int]
    """(rows, columns) of one frame's head map."""


class NeckRulebookBuilder:
    """Builder of a neck's rulebooks, which reuses its memory: for one thread at a time.

    Args:
        ny, nx: pillars of the map, multiples of 8.
        rule: which cells are active.
        training: also the rulebooks that the backward pass reads.
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
        self._strided_maps = [build_kernel_map(STRIDED, *maps) for maps in zip(before, self._strided, strict=True)]
        self._dilated_maps = [build_kernel_map(SAME, *maps) for maps in zip(self._strided, self._outputs, strict=True)]
        self._submanifold_maps = [build_kernel_map(SAME, level, level) for level in self._outputs]
        strides = [map_convolution(1 << level, stride=1 << level) for level in range(LEVELS)]
        self._upsampling_maps = [
            build_kernel_map(stride, self._head, level) for stride, level in zip(strides, self._outputs, strict=True)
        ]

    def build(self, cells: NDArray[np.int64]) -> NeckRulebooks[NDArray[np.int32]]:
        """Build the rulebooks of a scan with pillars at these cells (P,): flat indices row * nx + column, ascending."""
        self._activate(cells)
        levels = []
        for number in range(LEVELS):
            strided_map, dilated_map, submanifold_map = (
                self._strided_maps[number],
                self._dilated_maps[number],
                self._submanifold_maps[number],
            )
            strided, output = dilated_map.source, dilated_map.target
            same = submanifold_map.rulebook()
            levels.append(
                LevelRulebooks(
                    strided=strided_map.rulebook(),
                    first=same if strided is output else dilated_map.rulebook(),
                    same=same,
                    strided_back=strided_map.inverse() if self.training else _NO_RULEBOOK,
                    first_back=dilated_map.inverse() if self.training else _NO_RULEBOOK,
                    strided_cells=strided.cells.astype(np.int32),
                    cells=output.cells.astype(np.int32),
                    places=self._head.places(output, number),
                )
            )
        return NeckRulebooks(tuple(levels), self._head.cells.astype(np.int32), (len(self._head),), self._head.shape[1:])

    def _activate(self, cells: NDArray[np.int64]) -> None:
        """Activate the cells of every map according to the rule."""
        self._pillars.activate(cells)
        before = self._pillars
        for strided_map, level in zip(self._strided_maps, self._strided, strict=True):
            level.activate_joined([(before, strided_map.outputs)])  # the coarser levels do not see the growth
            before = level
        if self.rule == "fine":
            dilated_map = self._dilated_maps[0]
            dilated_map.target.activate_joined([(dilated_map.source, dilated_map.outputs)])
        self._head.activate_joined([(upsampling.target, upsampling.inputs) for upsampling in self._upsampling_maps])


def stack_neck_rulebooks(
    frames: Sequence[NeckRulebooks[NDArray[np.int32]]], pillars: Sequence[int]
) -> NeckRulebooks[NDArray[np.int32]]:
    """Stack the rulebooks of frames into those of a batch.

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
            LevelRulebooks(
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
    return NeckRulebooks(
        tuple(levels),
        stack_cells([frame.head_cells for frame in frames], map_cells),
        tuple(len(frame.head_cells) for frame in frames),
        frames[0].map_shape,
    )


def rulebook_inputs(rulebooks: NeckRulebooks[Array]) -> dict[str, Array]:
    """Return the rulebooks by the names of a neck graph's inputs; a graph takes those that its layers read."""
    return {
        f"{kind}_{number}": getattr(level, kind)
        for number, level in enumerate(rulebooks.levels)
        for kind in ("strided", "first", "same", "places")
    }
