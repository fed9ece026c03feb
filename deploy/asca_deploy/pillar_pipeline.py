"""The pillar family's pipeline: pillarize, encode, scatter or tables, neck and head, decode (paper section 3)."""

from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_deploy import providers
from asca_deploy.bundle import BACKBONE, ENCODER, Bundle
from asca_deploy.canvas_backbone import CanvasBackbone
from asca_deploy.graph import Session, Tensor, check_interface
from asca_deploy.pillar_backbone import HeadAnswer, PillarBackbone
from asca_deploy.pipeline import Laps, Pipeline
from asca_deploy.table_backbone import TableBackbone
from asca_pillars.errors import ProviderError
from asca_pillars.geometry.decode import decode
from asca_pillars.geometry.detections import Detections
from asca_pillars.geometry.kernels import load_kernels
from asca_pillars.pillars.pillar_spec import PillarSpec
from asca_pillars.pillars.pillarize import FEATURES, KERNELS, PillarCounts, Pillars, pillarize

_NO_SPARSE_NECK = {
    "openvino": "it needs outputs of fixed shapes",
    "tensorrt": "it would build another engine for every number of pillars",
}


class PreparedPillars(NamedTuple):
    """A scan's pillars, encoded and placed for the backbone."""

    placed: Any
    counts: PillarCounts


class PillarPipeline:
    """See `pipeline.Pipeline`. The encoder always runs on onnxruntime's CPU provider.

    Args:
        folder: of the bundle.
        bundle: its manifest, verified by `load_bundle`.
        provider, precision, threads: of the backbone.

    Raises:
        BundleError: a graph cannot be run or is not what the manifest says.
        ProviderError: the provider does not start, or cannot run this backbone.
    """

    network_stages = ("encode", "neck+head")

    def __init__(
        self,
        folder: Path,
        bundle: Bundle,
        provider: providers.Provider = "cpu",
        precision: providers.Precision = "float32",
        threads: int = 1,
    ) -> None:
        load_kernels(KERNELS)  # here rather than in the first scan
        self.bundle = bundle
        self.spec: PillarSpec = bundle.spec
        self._encoder = _open_encoder(folder, bundle)
        path, neck = folder / bundle.graphs[BACKBONE].file, 0 if bundle.refine is None else bundle.refine.bev_channels
        self.backbone = open_backbone(path, bundle, provider, precision, threads, neck)
        self.stages = ("pillarize", "encode", self.backbone.stage, "neck+head", "decode")
        self._anchors = self.spec.anchors

    def prepare(self, points: NDArray[np.float32], laps: Laps) -> PreparedPillars:
        """Points (N, 4), metres, LiDAR frame, and reflectance -> the input of the backbone."""
        pillars = self.pillarize(points)
        laps.append(("pillarize", perf_counter()))
        features = self.encode(pillars)
        laps.append(("encode", perf_counter()))
        placed = self.backbone.place(features, pillars.cells)
        laps.append((self.backbone.stage, perf_counter()))
        return PreparedPillars(placed, pillars.stats)

    def infer(self, prepared: PreparedPillars, laps: Laps) -> HeadAnswer:
        """The placed pillars -> head maps (channels, H, W) of logits and residuals, or rows of the active cells."""
        answer = self.backbone.run(prepared.placed)
        laps.append(("neck+head", perf_counter()))
        return answer

    def finish(self, raw: HeadAnswer, laps: Laps) -> Detections:
        """Head maps (channels, H, W) -> boxes, LiDAR frame, above the score threshold that the rotated NMS keeps."""
        detections = decode(raw.maps, self._anchors, self.spec.classes, self.spec.post, raw.cells)
        laps.append(("decode", perf_counter()))
        return detections

    def pillarize(self, points: NDArray[np.float32]) -> Pillars:
        """Finite points (N, 4), metres, LiDAR frame -> the features of M points in P pillars. Paper section 3.2."""
        return pillarize(points, self.spec.grid, self.spec.limits)

    def encode(self, pillars: Pillars) -> NDArray[Any]:
        """Features (M, 9) -> unitless pillar features (P, C), of the canvas's type. Paper section 3.2."""
        if not len(pillars.cells):
            return np.empty((0, self.bundle.pillar.channels), self.bundle.pillar.canvas.type)
        values = {name: getattr(pillars, name) for name in self._encoder.inputs}  # a graph may not need all three
        return self._encoder.run(("pillar_features",), values)[0]


def _open_encoder(folder: Path, bundle: Bundle) -> Session:
    # One thread: the maximum over a pillar's points is a ScatterND with repeated indices, and onnxruntime's threads
    # race for them: now and then a few features come out too small (onnxruntime issue 18048; seen with 1.31). It is
    # still the fastest form, ten times faster than ScatterElements.
    path = folder / bundle.graphs[ENCODER].file
    inputs = {
        "features": Tensor("float32", (None, len(FEATURES))),
        "pillar_index": Tensor("int64", (None,)),
        "point_counts": Tensor("int64", (None,)),
    }
    outputs = {"pillar_features": Tensor(bundle.pillar.canvas.type, (None, bundle.pillar.channels))}
    return check_interface(path, providers.open_session(path, "cpu", "float32", threads=1), inputs, outputs)


def open_backbone(
    path: Path,
    bundle: Bundle,
    provider: providers.Provider,
    precision: providers.Precision,
    threads: int,
    neck_channels: int = 0,
) -> PillarBackbone:
    """Open backbone.onnx of a dense or of a sparse neck; with `neck_channels` it has the output NECK.

    Raises:
        BundleError: the graph cannot be run or is not what the manifest says.
        ProviderError: the provider does not start, or cannot run a sparse neck.
    """
    if bundle.pillar.neck == "sparse" and provider in _NO_SPARSE_NECK:
        raise ProviderError(
            f"provider {provider} cannot run the sparse neck of {bundle.name}: {_NO_SPARSE_NECK[provider]}; "
            "choose provider cpu, or a bundle with a dense neck such as asca_small_sim"
        )
    session = providers.open_session(path, provider, precision, threads)
    kind = CanvasBackbone if bundle.pillar.neck == "dense" else TableBackbone
    return kind(path, session, bundle, neck_channels)


_: type[Pipeline[PreparedPillars, HeadAnswer]] = PillarPipeline  # mypy compares them
