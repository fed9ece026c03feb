"""The pillar family's pipeline: pillarize, encode, scatter, neck and head, decode (paper section 3)."""

from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asca_deploy import providers
from asca_deploy.bundle import BACKBONE, ENCODER, NECK, Bundle, CanvasFormat
from asca_deploy.graph import Session, Tensor, check_interface
from asca_deploy.pipeline import Laps, Pipeline
from asca_pillars.geometry.decode import HeadMaps, decode
from asca_pillars.geometry.detections import Detections
from asca_pillars.pillars.grid import PillarGrid
from asca_pillars.pillars.pillar_spec import PillarSpec
from asca_pillars.pillars.pillarize import FEATURES, PillarCounts, Pillars, pillarize
from asca_pillars.second_stage.first_stage import FirstPass

Maps: TypeAlias = HeadMaps[NDArray[np.float32]]


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


class PreparedPillars(NamedTuple):
    """A scan's pillars, encoded and scattered."""

    canvas: Canvas
    counts: PillarCounts


class PillarPipeline:
    """See `pipeline.Pipeline`. The encoder always runs on onnxruntime's CPU provider.

    Every scan between `prepare` and `infer` has a canvas of its own, taken from those that are free. There are as many
    as there ever were such scans at once: one in single calls, two in a stream, one per thread with several threads;
    each takes (nx + 1)(ny + 1) C values, 5 MiB in the 8-bit bundle that ships and 20 MiB in the float one.

    Args:
        folder: of the bundle.
        bundle: its manifest, verified by `load_bundle`.
        provider, precision, threads: of the backbone.

    Raises:
        BundleError: a graph cannot be run or is not what the manifest says.
        ProviderError: the provider does not start.
    """

    stages = ("pillarize", "encode", "scatter", "neck+head", "decode")
    network_stages = ("encode", "neck+head")

    def __init__(
        self,
        folder: Path,
        bundle: Bundle,
        provider: providers.Provider = "cpu",
        precision: providers.Precision = "float32",
        threads: int = 1,
    ) -> None:
        self.bundle = bundle
        self.spec: PillarSpec = bundle.spec
        self._encoder = _open_encoder(folder, bundle)
        self._backbone = _open_backbone(folder, bundle, provider, precision, threads)
        self._anchors = self.spec.anchors
        self._free = [self.new_canvas()]

    def prepare(self, points: NDArray[np.float32], laps: Laps) -> PreparedPillars:
        """Points (N, 4) -> the pseudo-image, on a canvas that `infer` gives back."""
        pillars = self.pillarize(points)
        laps.append(("pillarize", perf_counter()))
        features = self.encode(pillars)
        laps.append(("encode", perf_counter()))
        try:
            canvas = self._free.pop()  # atomic, as append is: two threads never get the same one
        except IndexError:
            canvas = self.new_canvas()
        canvas.scatter(features, pillars.cells)
        laps.append(("scatter", perf_counter()))
        return PreparedPillars(canvas, pillars.stats)

    def infer(self, prepared: PreparedPillars, laps: Laps) -> Maps:
        """The canvas -> logits and residuals on the head's map."""
        maps = self.neck_and_head(prepared.canvas.image)
        self._free.append(prepared.canvas)
        laps.append(("neck+head", perf_counter()))
        return maps

    def infer_with_neck(self, prepared: PreparedPillars, laps: Laps) -> FirstPass:
        """As `infer`, of a bundle of kind pillar_refine: also what its second stage reads."""
        *maps, neck = self._backbone.run((*HeadMaps._fields, NECK), {"canvas": prepared.canvas.image})
        self._free.append(prepared.canvas)
        laps.append(("neck+head", perf_counter()))
        return FirstPass(_channels_first(maps), neck[0])

    def finish(self, raw: Maps, laps: Laps) -> Detections:
        """Head maps -> boxes above the score threshold that survive the rotated NMS."""
        detections = decode(raw, self._anchors, self.spec.classes, self.spec.post)
        laps.append(("decode", perf_counter()))
        return detections

    def pillarize(self, points: NDArray[np.float32]) -> Pillars:
        """Finite points (N, 4), metres, LiDAR frame -> the features of M points in P pillars. Paper section 3.2."""
        return pillarize(points, self.spec.grid, self.spec.limits)

    def encode(self, pillars: Pillars) -> NDArray[Any]:
        """Features (M, 9) -> pillar features (P, C), of the canvas's type. Paper section 3.2."""
        if not len(pillars.cells):
            return np.empty((0, self.bundle.pillar.channels), self.bundle.pillar.canvas.type)
        values = {name: getattr(pillars, name) for name in self._encoder.inputs}  # a graph may not need all three
        return self._encoder.run(("pillar_features",), values)[0]

    def new_canvas(self) -> Canvas:
        """An empty canvas of this bundle's format."""
        return Canvas(self.bundle.pillar.channels, self.spec.grid, self.bundle.pillar.canvas)

    def neck_and_head(self, canvas: NDArray[Any]) -> Maps:
        """Pseudo-image (1, ny + 1, nx + 1, C) -> logits and residuals on the head's map. Paper Table 1."""
        channels_last = self._backbone.run(HeadMaps._fields, {"canvas": canvas})
        return _channels_first(channels_last)


def _channels_first(channels_last: list[NDArray[Any]]) -> Maps:
    scores, boxes, directions = (maps[0].transpose(2, 0, 1) for maps in channels_last)
    return HeadMaps(scores, boxes, directions)


def _open_encoder(folder: Path, bundle: Bundle) -> Session:
    # One thread: the maximum over a pillar's points is a ScatterND with repeated indices, and onnxruntime's threads
    # race for them: now and then a few features come out too small (onnxruntime issue 18048; seen with 1.31). It is
    # the fastest form all the same, ten times faster than ScatterElements.
    path = folder / bundle.graphs[ENCODER].file
    inputs = {
        "features": Tensor("float32", (None, len(FEATURES))),
        "pillar_index": Tensor("int64", (None,)),
        "point_counts": Tensor("int64", (None,)),
    }
    outputs = {"pillar_features": Tensor(bundle.pillar.canvas.type, (None, bundle.pillar.channels))}
    return check_interface(path, providers.open_session(path, "cpu", "float32", threads=1), inputs, outputs)


def _open_backbone(
    folder: Path, bundle: Bundle, provider: providers.Provider, precision: providers.Precision, threads: int
) -> Session:
    grid, anchors = bundle.spec.grid, bundle.spec.anchors.shape[2]
    path = folder / bundle.graphs[BACKBONE].file
    inputs = {"canvas": Tensor(bundle.pillar.canvas.type, (1, grid.ny + 1, grid.nx + 1, bundle.pillar.channels))}
    outputs = {
        name: Tensor("float32", (1, *grid.head_shape, channels * anchors))
        for name, channels in (("scores", 1), ("boxes", 7), ("directions", 2))
    }
    if bundle.refine is not None:
        outputs[NECK] = Tensor("float32", (1, *grid.head_shape, bundle.refine.bev_channels))
    return check_interface(path, providers.open_session(path, provider, precision, threads), inputs, outputs)


_: type[Pipeline[PreparedPillars, Maps]] = PillarPipeline  # mypy compares them
