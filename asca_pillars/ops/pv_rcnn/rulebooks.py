"""Rulebooks of a backbone over voxels: strided convolutions join its levels (SECOND, PV-RCNN)."""

import math
from collections.abc import Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from asca_pillars.ops.sparse.rulebooks import CellMap, Convolution, Shape, build_kernel_map, stack_rows

SUBMANIFOLD = Convolution((3, 3, 3), (1, 1, 1), (1, 1, 1))
PV_RCNN_STRIDED = (
    Convolution((3, 3, 3), (2, 2, 2), (1, 1, 1)),
    Convolution((3, 3, 3), (2, 2, 2), (1, 1, 1)),
    Convolution((3, 3, 3), (2, 2, 2), (0, 1, 1)),
    Convolution((3, 1, 1), (2, 1, 1), (0, 0, 0)),
)
"""conv2, conv3, conv4 and conv_out; they take 41 cells along z to 21, 11, 5 and 2."""


Array = TypeVar("Array")


class VoxelLevel(NamedTuple, Generic[Array]):
    """N active cells of one level, of one scan (NumPy) or of a batch (tensors)."""

    cells: Array
    """(N,) int64 flat index (y * nx + x) * nz + z on this level's lattice, ascending; of a batch, frame by frame,
    counted through the lattices of its frames."""
    same: Array
    """(N, 27) of submanifold convolutions; empty on a level that has none."""
    strided: Array
    """(N, K) rows of the level before; empty on the first."""
    strided_back: Array
    """(rows of the level before, K) the inverse of `strided`, for training; empty without."""


class VoxelRulebookBuilder:
    """Builder of a backbone's rulebooks, which reuses its memory: for one thread at a time.

    Args:
        shape: of the first level's lattice, cells along z, y, x.
        strided: convolutions from each level to the next.
        submanifold: whether each level has submanifold convolutions, the first one included.
        training: also the rulebooks that the backward pass reads.

    Raises:
        ConfigError: a lattice that is too tall or too large, see `CellMap`.
    """

    def __init__(
        self,
        shape: Shape,
        strided: Sequence[Convolution] = PV_RCNN_STRIDED,
        submanifold: Sequence[bool] = (True, True, True, True, False),
        *,
        training: bool = False,
    ) -> None:
        if len(submanifold) != len(strided) + 1:
            raise ValueError(f"{len(strided)} strided convolutions join {len(strided) + 1} levels, not {submanifold}")
        self.strided, self.submanifold, self.training = tuple(strided), tuple(submanifold), training
        self.maps = [CellMap(shape)]
        """Map of each level; the caller fills the first one with the voxels."""
        for convolution in strided:
            self.maps.append(CellMap(convolution.output_shape(self.maps[-1].shape)))
        self._strided_maps = [
            build_kernel_map(*layer) for layer in zip(self.strided, self.maps[:-1], self.maps[1:], strict=True)
        ]
        self._submanifold_maps = [build_kernel_map(SUBMANIFOLD, level, level) for level in self.maps]

    def build(self) -> list[VoxelLevel[NDArray[Any]]]:
        """Build the rulebooks for the active cells of `maps[0]`, level by level."""
        levels = [self._level(0)]
        for number, stride in enumerate(self._strided_maps, start=1):
            stride.target.activate_joined([(stride.source, stride.outputs)])
            strided = stride.rulebook()
            back = stride.inverse() if self.training else _none(strided.shape[1])
            levels.append(self._level(number)._replace(strided=strided, strided_back=back))
        return levels

    def _level(self, number: int) -> VoxelLevel[NDArray[Any]]:
        same = self._submanifold_maps[number].rulebook() if self.submanifold[number] else _none(SUBMANIFOLD.taps)
        return VoxelLevel(self.maps[number].cells, same, _none(0), _none(0))


def stack_voxel_levels(
    frames: Sequence[Sequence[VoxelLevel[NDArray[Any]]]], shapes: Sequence[Shape]
) -> list[VoxelLevel[NDArray[Any]]]:
    """Stack the levels of frames into those of a batch; `shapes` are the levels' lattices, cells along z, y, x."""
    stacked: list[VoxelLevel[NDArray[Any]]] = []
    before: list[int] = []
    for number, shape in enumerate(shapes):
        parts = [frame[number] for frame in frames]
        rows = [len(part.cells) for part in parts]
        starts = [frame * math.prod(shape) for frame in range(len(frames))]
        stacked.append(
            VoxelLevel(
                cells=np.concatenate([part.cells + start for part, start in zip(parts, starts, strict=True)]),
                same=stack_rows([part.same for part in parts], rows),
                strided=stack_rows([part.strided for part in parts], before or rows),
                strided_back=stack_rows([part.strided_back for part in parts], rows),
            )
        )
        before = rows
    return stacked


def _none(taps: int) -> NDArray[np.int32]:
    return np.empty((0, taps), np.int32)
