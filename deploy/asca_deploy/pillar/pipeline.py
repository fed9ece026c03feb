"""The pillar family's pipeline: pillarize, encode, scatter or rulebooks, neck and head, decode (paper section 3)."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from asca_deploy import providers
from asca_deploy.bundle import BACKBONE, NECK, CanvasFormat, PillarBundle
from asca_deploy.graph import Session, check_interface
from asca_deploy.pillar.encoder import Encoder
from asca_deploy.pillar.graphs import (
    PILLAR_FEATURES,
    HeadOutputs,
    Maps,
    PillarBackbone,
    backbone_interface,
    check_neck,
    output_channels,
)
from asca_deploy.pipeline import Pipeline, StageTimes
from asca_pillars.base.kernels import load_kernels
from asca_pillars.detection.decode import HeadMaps, decode
from asca_pillars.detection.detections import Detections
from asca_pillars.ops.pillar.grid import PillarGrid, map_cells, pool_pillars
from asca_pillars.ops.pillar.neck_rulebooks import NeckRulebookBuilder, NeckRulebooks, rulebook_inputs
from asca_pillars.ops.pillar.prepare import KERNELS, PillarCounts, Pillars, pillarize
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.ops.two_stage.first_stage import FirstStageOutputs

T = TypeVar("T")


class PreparedPillars(NamedTuple):
    """A scan's pillars, encoded and placed for the backbone."""

    placed: Any
    counts: PillarCounts


class PillarPipeline:
    """See `pipeline.Pipeline`. The encoder always runs on onnxruntime's CPU provider.

    Args:
        folder: of the bundle.
        bundle: its manifest, verified by `load_pillar_bundle`.
        provider, precision, threads: of the backbone.

    Raises:
        BundleError: a graph cannot be run or does not match the manifest.
        ProviderError: the provider does not start, or cannot run this backbone.
    """

    network_stages = ("encode", "neck+head")

    def __init__(
        self,
        folder: Path,
        bundle: PillarBundle,
        provider: providers.Provider = "cpu",
        precision: providers.Precision = "float32",
        threads: int = 1,
    ) -> None:
        load_kernels(KERNELS)  # here rather than in the first scan
        self.bundle = bundle
        self.spec: PillarSpec = bundle.spec
        self.encode = Encoder(folder, bundle)
        path, neck = folder / bundle.graphs[BACKBONE].file, 0 if bundle.refine is None else bundle.refine.bev_channels
        self.backbone = open_backbone(path, bundle, provider, precision, threads, neck)
        self.stages = ("pillarize", "encode", self.backbone.stage, "neck+head", "decode")
        self._anchors = self.spec.anchors
        self._executor = ThreadPoolExecutor(1) if threads > 1 and bundle.pillar.neck == "sparse" else None

    def prepare(self, points: NDArray[np.float32], stage_times: StageTimes) -> PreparedPillars:
        """Prepare the backbone's input from points (N, 4), metres, LiDAR frame, and reflectance."""
        pillars = self.pillarize(points)
        stage_times.append(("pillarize", perf_counter()))
        # The encoder runs on one thread, see `encoder._open`: another core builds the rulebooks meanwhile.
        building = self._executor and self._executor.submit(self.backbone.build_rulebooks, pillars.cells)
        features = self.encode(pillars)
        stage_times.append(("encode", perf_counter()))
        placed = self.backbone.place(features, pillars.cells, building and building.result())
        stage_times.append((self.backbone.stage, perf_counter()))
        return PreparedPillars(placed, pillars.stats)

    def infer(self, prepared: PreparedPillars, stage_times: StageTimes) -> HeadOutputs:
        """Run the backbone: head maps (channels, H, W) of logits and residuals, or rows of the active cells."""
        answer = self.backbone.run(prepared.placed)
        stage_times.append(("neck+head", perf_counter()))
        return answer

    def finish(self, raw: HeadOutputs, stage_times: StageTimes) -> Detections:
        """Decode head maps (channels, H, W) into boxes, LiDAR frame, by score thresholds and rotated NMS."""
        spec = self.spec
        detections = decode(raw.maps, self._anchors, spec.classes, spec.post, raw.cells, spec.direction_offset_rad)
        stage_times.append(("decode", perf_counter()))
        return detections

    def pillarize(self, points: NDArray[np.float32]) -> Pillars:
        """Sort finite points (N, 4), metres, LiDAR frame, into P pillars: features of M points. Paper section 3.2."""
        return pillarize(points, self.spec.grid, self.spec.limits)


def open_backbone(
    path: Path,
    bundle: PillarBundle,
    provider: providers.Provider,
    precision: providers.Precision,
    threads: int,
    neck_channels: int = 0,
) -> PillarBackbone:
    """Open backbone.onnx of a dense or of a sparse neck; with `neck_channels` it has the output NECK.

    Raises:
        BundleError: the graph cannot be run or does not match the manifest.
        ProviderError: the provider does not start, or cannot run a sparse neck.
    """
    check_neck(bundle, provider)
    session = providers.open_session(path, provider, precision, threads)
    in_steps = NECK in session.outputs and session.outputs[NECK].type == "uint8"
    check_interface(path, session, *backbone_interface(bundle, neck_channels, "uint8" if in_steps else "float32"))
    return (
        DenseBackbone(session, bundle)
        if bundle.pillar.neck == "dense"
        else SparseBackbone(session, bundle, neck_channels)
    )


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


class DenseBackbone:
    """backbone.onnx of a dense neck, see `pillar.backbone.PillarBackbone`.

    Every scan between `place` and `run` has a canvas of its own, taken from those that are free. There are as many
    as there ever were such scans at once: one in single calls, two in a stream, one per thread with several threads;
    each takes (nx + 1)(ny + 1) C values, 5 MiB for 32 channels in 8 bits and 20 MiB in float32.

    Args:
        session: that has opened it, see `open_backbone`.
        bundle: the manifest.
    """

    stage = "scatter"

    def __init__(self, session: Session, bundle: PillarBundle) -> None:
        self._session, self._bundle = session, bundle
        self._free = [self.new_canvas()]

    def build_rulebooks(self, cells: NDArray[np.int64]) -> None:
        """Return None: a dense neck has no rulebooks."""

    def place(self, pillar_features: NDArray[Any], cells: NDArray[np.int64], rulebooks: None = None) -> Canvas:
        """Place pillar features (P, C) at their cells, flat indices (P,), on a canvas that `run` gives back."""
        canvas = take_or_create(self._free, self.new_canvas)
        canvas.scatter(*pool_pillars(pillar_features, cells, self._bundle.spec.grid))
        return canvas

    def run(self, placed: Canvas) -> HeadOutputs:
        """Run the graph on the canvas: logits and residuals on the head's map."""
        maps = self.neck_and_head(placed.image)
        self._free.append(placed)
        return HeadOutputs(maps, None)

    def infer_with_neck(self, placed: Canvas) -> FirstStageOutputs:
        """Run the graph as `run` does, and return the neck's map (H, W, C) too; for graphs with the output NECK."""
        *maps, neck = self._session.run((*HeadMaps._fields, NECK), {"canvas": placed.image})
        self._free.append(placed)
        return FirstStageOutputs(channels_first(maps), neck[0])

    def new_canvas(self) -> Canvas:
        """Return an empty canvas of this bundle's format."""
        return Canvas(self._bundle.pillar.channels, self._bundle.spec.grid, self._bundle.pillar.canvas)

    def neck_and_head(self, canvas: NDArray[Any]) -> Maps:
        """Run the graph on the pseudo-image (1, ny + 1, nx + 1, C): logits and residuals. Paper Table 1."""
        return channels_first(self._session.run(HeadMaps._fields, {"canvas": canvas}))


class SparseBackboneInputs(NamedTuple):
    """Inputs of the graph for one scan."""

    features: NDArray[Any]
    """(P, C), or (cells, C) with a pooled map."""
    rulebooks: NeckRulebooks[NDArray[np.int32]]


class SparseBackbone:
    """backbone.onnx of a sparse neck, see `pillar.backbone.PillarBackbone`.

    Rulebooks are built in memory that is kept from scan to scan, as many builders as threads ever built at once; the
    rulebooks themselves belong to their scan.

    Args:
        session: that has opened it, see `open_backbone`.
        bundle: the manifest.
        neck_channels: of the graph's output NECK, if it has one.
    """

    stage = "rulebooks"

    def __init__(self, session: Session, bundle: PillarBundle, neck_channels: int = 0) -> None:
        self._session, self._bundle = session, bundle
        self._channels = output_channels(bundle, neck_channels)
        self._free = [self._new_builder()]

    def build_rulebooks(self, cells: NDArray[np.int64]) -> NeckRulebooks[NDArray[np.int32]]:
        """Build the rulebooks of the cells, flat indices (P,)."""
        mapped = map_cells(cells, self._bundle.spec.grid)
        builder = take_or_create(self._free, self._new_builder)
        rulebooks = builder.build(cells if mapped is None else mapped.cells)
        self._free.append(builder)
        return rulebooks

    def place(
        self,
        pillar_features: NDArray[Any],
        cells: NDArray[np.int64],
        rulebooks: NeckRulebooks[NDArray[np.int32]] | None = None,
    ) -> SparseBackboneInputs:
        """Return pillar features (P, C) with the rulebooks of their cells, flat indices (P,)."""
        pooled, _ = pool_pillars(pillar_features, cells, self._bundle.spec.grid)
        return SparseBackboneInputs(pooled, rulebooks or self.build_rulebooks(cells))

    def run(self, placed: SparseBackboneInputs) -> HeadOutputs:
        """Run the graph: scores (M, A), boxes (M, 7A), directions (M, 2A) at M active head cells."""
        return HeadOutputs(HeadMaps(*self._rows(placed, HeadMaps._fields)), placed.rulebooks.head_cells)

    def infer_with_neck(self, placed: SparseBackboneInputs) -> FirstStageOutputs:
        """Run the graph as `run` does, and return the head's input (M, C) too; for graphs with the output NECK."""
        *maps, neck = self._rows(placed, (*HeadMaps._fields, NECK))
        return FirstStageOutputs(HeadMaps(*maps), neck, placed.rulebooks.head_cells)

    def _rows(self, placed: SparseBackboneInputs, names: Sequence[str]) -> list[NDArray[np.float32]]:
        if not len(placed.rulebooks.head_cells):
            return [np.empty((0, self._channels[name]), np.float32) for name in names]
        given = {PILLAR_FEATURES: placed.features, **rulebook_inputs(placed.rulebooks)}
        return run_graph(self._session, names, given)

    def _new_builder(self) -> NeckRulebookBuilder:
        rule = self._bundle.pillar.active_cells
        assert rule is not None
        return NeckRulebookBuilder(*self._bundle.spec.grid.map_shape, rule)


def run_graph(session: Session, outputs: Sequence[str], given: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]:
    """Run a graph for the outputs of these names; given inputs that it lacks are left out."""
    return session.run(outputs, {name: given[name] for name in session.inputs})


def take_or_create(free: list[T], make: Callable[[], T]) -> T:
    """Return a free item, or a new one; appending it to `free` gives it back."""
    try:
        return free.pop()  # atomic, as append is: two threads never get the same one
    except IndexError:
        return make()


def channels_first(channels_last: Sequence[NDArray[Any]]) -> HeadMaps[NDArray[np.float32]]:
    """Transpose head maps of one scan from a graph's (1, H, W, C) to (C, H, W) each."""
    return HeadMaps(*(maps[0].transpose(2, 0, 1) for maps in channels_last))


_: type[Pipeline[PreparedPillars, HeadOutputs]] = PillarPipeline  # mypy compares them
