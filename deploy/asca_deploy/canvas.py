"""The scatter between the two graphs: pillar features back to their places in the pseudo-image."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from asca_pillars.pillars.grid import PillarGrid
from asca_pillars.schema import Strict


@dataclass(frozen=True)
class CanvasFormat(Strict):
    """What backbone.onnx takes for a pseudo-image, and encoder.onnx gives for a pillar.

    Attributes:
        type: of one value; uint8 is in the steps of the quantized graph, which saves it the conversion.
        empty: value of each channel (C,) where there is no pillar; () stands for zeros. A quantized channel has a zero
            of its own, because attention makes features negative.
    """

    type: Literal["float32", "uint8"] = "float32"
    empty: tuple[int, ...] = ()


class Canvas:
    """The pseudo-image (1, ny + 1, nx + 1, C), channels last, allocated once and kept from frame to frame.

    Its first row and column are the padding of the network's first convolution, so that they can hold whatever stands
    for zero. Channels last, a pillar is one run of memory. A frame fills a few percent of the cells: clearing only the
    cells of the frame before is many times faster than a new image, 64 MB for the paper's grid.
    """

    def __init__(self, channels: int, grid: PillarGrid, format: CanvasFormat | None = None) -> None:
        format = format or CanvasFormat()
        self.image: NDArray[Any] = np.empty((1, grid.ny + 1, grid.nx + 1, channels), format.type)
        self._empty = np.array(format.empty or [0] * channels, format.type)
        self._cells = self.image.reshape(-1, channels)
        self._cells[:] = self._empty
        self._nx = grid.nx
        self._occupied = np.empty(0, np.int64)

    def scatter(self, pillar_features: NDArray[Any], cells: NDArray[np.int64]) -> NDArray[Any]:
        """Write each pillar's features into its cell; every other cell is empty.

        Args:
            pillar_features: (P, C), of the format's type.
            cells: (P,) flat indices row * nx + column, each at most once.

        Returns:
            The pseudo-image (1, ny + 1, nx + 1, C). It is this object's own memory: valid until the next call.
        """
        self._cells[self._occupied] = self._empty
        rows, columns = np.divmod(cells, self._nx)
        self._occupied = (rows + 1) * (self._nx + 1) + columns + 1
        self._cells[self._occupied] = pillar_features
        return self.image
