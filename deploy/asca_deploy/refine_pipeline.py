"""The pipeline of kind pillar_refine: a pillar detector proposes, a second graph refines (PV-RCNN, section 3)."""

from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_deploy import providers
from asca_deploy.bundle import REFINE, Bundle, RefineSection
from asca_deploy.graph import Session, Tensor, check_interface
from asca_deploy.pillar_pipeline import CanvasBackbone, PillarPipeline, PreparedPillars
from asca_deploy.pipeline import Laps, Pipeline
from asca_pillars.errors import BundleError
from asca_pillars.geometry.detections import Detections
from asca_pillars.geometry.kernels import load_kernels
from asca_pillars.pillars.pillar_spec import PillarSpec
from asca_pillars.pillars.pillarize import PillarCounts
from asca_pillars.points import ball_query, columns
from asca_pillars.points.first_stage import FirstPass, proposed_from
from asca_pillars.points.refine_geometry import ROI_FEATURES, RefineScan, refine_scan
from asca_pillars.points.refined_detections import reported_detections

OUTPUTS = ("confidence", "residuals")


class PreparedScan(NamedTuple):
    """A scan whose pillars are encoded and scattered."""

    pillars: PreparedPillars
    points: NDArray[np.float32]
    """(N, 4), which the second stage looks at again."""

    @property
    def counts(self) -> PillarCounts:
        """What became of its points in the first stage."""
        return self.pillars.counts


class FirstAnswer(NamedTuple):
    """What the first stage says of a scan."""

    found: FirstPass
    points: NDArray[np.float32]


class RefinePipeline:
    """See `pipeline.Pipeline`.

    `provider` and `precision` are the backbone's; the second stage's graph is small and takes positions in metres, so
    it runs on onnxruntime's CPU provider in float32.

    Args:
        folder: of the bundle.
        bundle: its manifest, verified by `load_bundle`.
        provider, precision, threads: of the backbone; the second stage has as many threads.

    Raises:
        BundleError: a graph cannot be run or is not what the manifest says.
        ProviderError: the provider does not start.
    """

    stages = ("pillarize", "encode", "scatter", "neck+head", "propose", "neighbors", "refine", "decode")
    network_stages = ("encode", "neck+head", "refine")

    def __init__(
        self,
        folder: Path,
        bundle: Bundle,
        provider: providers.Provider = "cpu",
        precision: providers.Precision = "float32",
        threads: int = 1,
    ) -> None:
        if bundle.refine is None:
            raise BundleError(f"{folder}: a bundle of kind {bundle.kind} has no second stage")
        for kernels in (ball_query.KERNELS, columns.KERNELS):
            load_kernels(kernels)  # here rather than in the first scan
        self.spec: PillarSpec = bundle.spec
        self.section = bundle.refine
        self.first = PillarPipeline(folder, bundle, provider, precision, threads)
        backbone = self.first.backbone
        assert isinstance(backbone, CanvasBackbone), "`load_bundle` lets no sparse neck through"
        self.backbone = backbone
        path = folder / bundle.graphs[REFINE].file
        session = providers.open_session(path, "cpu", "float32", threads)
        inputs, outputs = refine_interface(bundle.refine, len(bundle.spec.classes))
        self._second: Session = check_interface(path, session, inputs, outputs)

    def prepare(self, points: NDArray[np.float32], laps: Laps) -> PreparedScan:
        """Points (N, 4) -> the first stage's pseudo-image."""
        return PreparedScan(self.first.prepare(points, laps), points)

    def infer(self, prepared: PreparedScan, laps: Laps) -> FirstAnswer:
        """The pseudo-image -> the first stage's head maps and its neck's map."""
        found = self.backbone.infer_with_neck(prepared.pillars.placed)
        laps.append(("neck+head", perf_counter()))
        return FirstAnswer(found, prepared.points)

    def finish(self, raw: FirstAnswer, laps: Laps) -> Detections:
        """Head maps -> proposals -> refined boxes above the score threshold that survive the rotated NMS."""
        proposed = proposed_from(raw.found, raw.points, self.spec, self.section.seen)
        laps.append(("propose", perf_counter()))
        scan = refine_scan(raw.points, proposed, proposed.proposals, self.section.neighbors)
        laps.append(("neighbors", perf_counter()))
        confidence, residuals = self.refine(scan)
        laps.append(("refine", perf_counter()))
        detections = reported_detections(proposed.proposals, confidence, residuals, self.spec)
        laps.append(("decode", perf_counter()))
        return detections

    def refine(self, scan: RefineScan) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Confidence logits (R,) and residuals (R, 7) of the proposals of a scan."""
        if not len(scan.roi_features):
            return np.empty(0, np.float32), np.empty((0, 7), np.float32)
        feed = refine_inputs(scan)
        confidence, residuals = self._second.run(OUTPUTS, {name: feed[name] for name in self._second.inputs})
        return confidence, residuals


def refine_inputs(scan: RefineScan) -> dict[str, NDArray[Any]]:
    """What refine.onnx takes, by name, in the order in which the graph declares it."""
    return {
        "points": scan.points,
        "keypoints": scan.keypoints,
        "bev": scan.bev,
        **{f"ball_{number}": indices for number, indices in enumerate(scan.ball_indices)},
        "grid_points": scan.grid_points,
        **{f"grid_{number}": indices for number, indices in enumerate(scan.grid_indices)},
        "roi_features": scan.roi_features,
    }


def refine_interface(section: RefineSection, classes: int) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Inputs and outputs of refine.onnx."""
    neighbors = section.neighbors
    inputs = {
        "points": Tensor("float32", (None, 4)),
        "keypoints": Tensor("float32", (None, 3)),
        "bev": Tensor("float32", (None, section.bev_channels)),
        "grid_points": Tensor("float32", (None, 3)),
        "roi_features": Tensor("float32", (None, classes + ROI_FEATURES)),
    }
    for number in range(len(neighbors.ball_radii_m)):
        inputs[f"ball_{number}"] = Tensor("int32", (None, neighbors.ball_samples))
    for number in range(len(neighbors.grid_radii_m)):
        inputs[f"grid_{number}"] = Tensor("int32", (None, neighbors.grid_samples))
    return inputs, {"confidence": Tensor("float32", (None,)), "residuals": Tensor("float32", (None, 7))}


_: type[Pipeline[PreparedScan, FirstAnswer]] = RefinePipeline  # mypy compares them
