"""The dense neck and head on the vehicle: pillars on a pseudo-image, one graph over all of it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_deploy.bundle import NECK, Bundle, CanvasFormat
from asca_deploy.graph import Session, Tensor, check_interface
from asca_deploy.pillar_backbone import HeadAnswer, Maps
from asca_pillars.geometry.decode import HeadMaps
from asca_pillars.pillars.grid import PillarGrid
from asca_pillars.pillars.map_pooling import pool_pillars
from asca_pillars.points.first_stage import FirstPass


class Canvas:
    """The pseudo-image (1, rows + 1, columns + 1, C), channels last, allocated once and kept from frame to frame.

    Its first row and column are the padding of the network's first convolution, so that they can hold whatever stands
    for zero. Channels last, a pillar is one run of memory. A frame fills a few percent of the cells: clearing only the
    cells of the frame before is many times faster than a new image, 64 MB for the paper's grid.
    """

    def __init__(self, channels: int, grid: PillarGrid, stored_as: CanvasFormat | None = None) -> None:
        stored_as = stored_as or CanvasFormat()
        rows, columns = grid.map_shape
        self.image: NDArray[Any] = np.empty((1, rows + 1, columns + 1, channels), stored_as.type)
        self._empty = np.array(stored_as.empty or [0] * channels, stored_as.type)
        self._cells = self.image.reshape(-1, channels)
        self._cells[:] = self._empty
        self._nx = columns
        self.occupied: NDArray[np.int64] = np.empty(0, np.int64)
        """(n,) rows of `image.reshape(-1, C)` that hold a pillar."""

    def scatter(self, pillar_features: NDArray[Any], cells: NDArray[np.int64]) -> NDArray[Any]:
        """Write each pillar's features into its cell; every other cell is empty.

        Args:
            pillar_features: (P, C), of the format's type.
            cells: (P,) flat indices row * columns + column on the map, each at most once.

        Returns:
            The pseudo-image (1, ny + 1, nx + 1, C). It is this object's own memory: valid until the next call.
        """
        self._cells[self.occupied] = self._empty
        rows, columns = np.divmod(cells, self._nx)
        self.occupied = (rows + 1) * (self._nx + 1) + columns + 1
        self._cells[self.occupied] = pillar_features
        return self.image


class CanvasBackbone:
    """backbone.onnx of a dense neck, see `pillar_backbone.PillarBackbone`.

    Every scan between `place` and `run` has a canvas of its own, taken from those that are free. There are as many
    as there ever were such scans at once: one in single calls, two in a stream, one per thread with several threads;
    each takes (nx + 1)(ny + 1) C values, 5 MiB in the 8-bit bundle that ships and 20 MiB in the float one.

    Args:
        path: of the graph, for messages.
        session: that has opened it.
        bundle: the manifest.

    Raises:
        BundleError: the graph's inputs and outputs are not those of this bundle.
    """

    stage = "scatter"

    def __init__(self, path: Path, session: Session, bundle: Bundle) -> None:
        self._bundle, self._pools = bundle, bundle.spec.grid.pools
        grid, section, anchors = bundle.spec.grid, bundle.pillar, bundle.spec.anchors.shape[2]
        rows, columns = grid.map_shape
        inputs = {"canvas": Tensor(section.canvas.type, (1, rows + 1, columns + 1, section.channels))}
        outputs = {
            name: Tensor("float32", (1, *grid.head_shape, channels * anchors))
            for name, channels in zip(HeadMaps._fields, (bundle.spec.scores_per_anchor, 7, 2), strict=True)
        }
        if bundle.refine is not None:
            outputs[NECK] = Tensor("float32", (1, *grid.head_shape, bundle.refine.bev_channels))
        self._session = check_interface(path, session, inputs, outputs)
        self._free = [self.new_canvas()]

    def place(self, pillar_features: NDArray[Any], cells: NDArray[np.int64]) -> Canvas:
        """Pillar features (P, C) at their cells, flat indices (P,), on a canvas that `run` gives back."""
        try:
            canvas = self._free.pop()  # atomic, as append is: two threads never get the same one
        except IndexError:
            canvas = self.new_canvas()
        if self._pools:
            pillar_features, cells = pool_pillars(pillar_features, cells, self._bundle.spec.grid)
        canvas.scatter(pillar_features, cells)
        return canvas

    def run(self, placed: Canvas) -> HeadAnswer:
        """The canvas -> logits and residuals on the head's map."""
        maps = self.neck_and_head(placed.image)
        self._free.append(placed)
        return HeadAnswer(maps, None)

    def infer_with_neck(self, placed: Canvas) -> FirstPass:
        """As `run`, of a bundle of kind pillar_refine: also the neck's map (H, W, C), which its second stage reads."""
        *maps, neck = self._session.run((*HeadMaps._fields, NECK), {"canvas": placed.image})
        self._free.append(placed)
        return FirstPass(_channels_first(maps), neck[0])

    def new_canvas(self) -> Canvas:
        """An empty canvas of this bundle's format."""
        return Canvas(self._bundle.pillar.channels, self._bundle.spec.grid, self._bundle.pillar.canvas)

    def neck_and_head(self, canvas: NDArray[Any]) -> Maps:
        """Pseudo-image (1, ny + 1, nx + 1, C) -> logits and residuals on the head's map. Paper Table 1."""
        return _channels_first(self._session.run(HeadMaps._fields, {"canvas": canvas}))


def _channels_first(channels_last: Sequence[NDArray[Any]]) -> Maps:
    scores, boxes, directions = (maps[0].transpose(2, 0, 1) for maps in channels_last)
    return HeadMaps(scores, boxes, directions)
