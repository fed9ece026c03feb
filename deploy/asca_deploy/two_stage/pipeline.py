"""Pipeline of kind pillar_refine: proposals of a pillar detector, refined by a second graph (PV-RCNN, section 3)."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_deploy import providers
from asca_deploy.bundle import REFINE, PillarBundle, RefineSection
from asca_deploy.graph import Interface, Session, Tensor, check_interface
from asca_deploy.pillar.pipeline import PillarPipeline, PreparedPillars, run_graph
from asca_deploy.pipeline import Pipeline, StageTimes
from asca_pillars.base.errors import BundleError
from asca_pillars.base.kernels import load_kernels
from asca_pillars.detection.detections import Detections
from asca_pillars.ops.pillar.prepare import PillarCounts
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.ops.points import neighbors, sampling
from asca_pillars.ops.points.neighbors import BallGroup, GroupedBalls, gather_balls, group_balls, group_widths
from asca_pillars.ops.two_stage.decode import reported_detections
from asca_pillars.ops.two_stage.first_stage import FirstStageOutputs, second_stage_inputs
from asca_pillars.ops.two_stage.prepare import ROI_FEATURES, RefineScan, refine_scan

OUTPUTS = ("confidence", "residuals")


class PreparedScan(NamedTuple):
    """A scan whose pillars are encoded and placed for the backbone."""

    pillars: PreparedPillars
    points: NDArray[np.float32]
    """(N, 4), which the second stage reads too."""

    @property
    def counts(self) -> PillarCounts:
        """Counts of the scan's points in the first stage."""
        return self.pillars.counts


class FirstStageResult(NamedTuple):
    """Outputs of the first stage for one scan."""

    outputs: FirstStageOutputs
    points: NDArray[np.float32]


class RefinePipeline:
    """See `pipeline.Pipeline`.

    `provider` and `precision` are the backbone's; the second stage's graph is small and takes positions in metres, so
    it runs on onnxruntime's CPU provider in float32.

    Args:
        folder: of the bundle.
        bundle: its manifest, verified by `load_pillar_bundle`.
        provider, precision, threads: of the backbone; the second stage has as many threads.

    Raises:
        BundleError: a graph cannot be run or does not match the manifest.
        ProviderError: the provider does not start.
    """

    network_stages = ("encode", "neck+head", "refine")

    def __init__(
        self,
        folder: Path,
        bundle: PillarBundle,
        provider: providers.Provider = "cpu",
        precision: providers.Precision = "float32",
        threads: int = 1,
    ) -> None:
        if bundle.refine is None:
            raise BundleError(f"{folder}: a bundle of kind {bundle.kind} has no second stage")
        for kernels in (neighbors.KERNELS, sampling.KERNELS):
            load_kernels(kernels)  # here rather than in the first scan
        self.spec: PillarSpec = bundle.spec
        self.section = bundle.refine
        self.first = PillarPipeline(folder, bundle, provider, precision, threads)
        self.stages = (*self.first.stages[:-1], "propose", "neighbors", "refine", "decode")
        path = folder / bundle.graphs[REFINE].file
        session = providers.open_session(path, "cpu", "float32", threads)
        inputs, outputs = refine_interface(bundle.refine, len(bundle.spec.classes))
        self._second: Session = check_interface(path, session, inputs, outputs)
        self._executor = ThreadPoolExecutor(1) if threads > 1 else None

    def prepare(self, points: NDArray[np.float32], stage_times: StageTimes) -> PreparedScan:
        """Prepare the input of the first stage's backbone from points (N, 4)."""
        return PreparedScan(self.first.prepare(points, stage_times), points)

    def infer(self, prepared: PreparedScan, stage_times: StageTimes) -> FirstStageResult:
        """Run the first stage's backbone: head maps and the neck's map, or rows of both."""
        outputs = self.first.backbone.infer_with_neck(prepared.pillars.placed)
        stage_times.append(("neck+head", perf_counter()))
        return FirstStageResult(outputs, prepared.points)

    def finish(self, raw: FirstStageResult, stage_times: StageTimes) -> Detections:
        """Decode proposals, refine them, and return the boxes that thresholds and rotated NMS keep."""
        proposed = second_stage_inputs(raw.outputs, raw.points, self.spec, self.section.seen)
        stage_times.append(("propose", perf_counter()))
        scan = refine_scan(raw.points, proposed, proposed.proposals, self.section.neighbors, self._executor)
        inputs = refine_inputs(scan)
        stage_times.append(("neighbors", perf_counter()))
        confidence, residuals = self.refine(inputs)
        stage_times.append(("refine", perf_counter()))
        detections = reported_detections(proposed.proposals, confidence, residuals, self.spec, self.section.scores)
        stage_times.append(("decode", perf_counter()))
        return detections

    def refine(self, inputs: Mapping[str, NDArray[Any]]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return confidence logits (R,) and residuals (R, 7) of the proposals of a scan, from its `refine_inputs`."""
        if not len(inputs["roi_features"]):
            return np.empty(0, np.float32), np.empty((0, 7), np.float32)
        confidence, residuals = run_graph(self._second, OUTPUTS, inputs)
        return confidence, residuals


def refine_inputs(scan: RefineScan) -> dict[str, NDArray[Any]]:
    """Return the inputs of refine.onnx by name, see `refine_interface`."""
    inputs: dict[str, NDArray[Any]] = {"keypoints": scan.keypoints, "bev": scan.bev}
    for number, indices in enumerate(scan.ball_indices):
        inputs[f"ball_{number}"] = gather_balls(scan.points, scan.keypoints, indices)
    inputs |= {"grid_points": scan.grid_points, "roi_features": scan.roi_features}
    for number, indices in enumerate(scan.grid_indices):
        names, balls = grid_names(number, indices.shape[1]), group_balls(indices, len(scan.keypoints))
        inputs[names.rows] = balls.rows
        for group, ball in zip(names.groups, balls.groups, strict=True):
            inputs |= zip(group, ball, strict=True)
    return inputs


def grid_names(number: int, samples: int) -> GroupedBalls[str]:
    """Return the names of the inputs for the balls around grid points, of one radius."""
    groups = [(f"grid_{number}_queries_{width}", f"grid_{number}_members_{width}") for width in group_widths(samples)]
    return GroupedBalls(tuple(BallGroup(*group) for group in groups), f"grid_{number}_rows")


def refine_interface(section: RefineSection, classes: int) -> Interface:
    """Return inputs and outputs of refine.onnx."""
    neighbors = section.neighbors
    inputs = {"keypoints": Tensor("float32", (None, 3)), "bev": Tensor("float32", (None, section.bev_channels))}
    for number in range(len(neighbors.ball_radii_m)):
        inputs[f"ball_{number}"] = Tensor("float32", (None, neighbors.ball_samples, 4))
    inputs["grid_points"] = Tensor("float32", (None, 3))
    inputs["roi_features"] = Tensor("float32", (None, classes + ROI_FEATURES))
    for number in range(len(neighbors.grid_radii_m)):
        names = grid_names(number, neighbors.grid_samples)
        inputs[names.rows] = Tensor("int32", (None,))
        for group, width in zip(names.groups, group_widths(neighbors.grid_samples), strict=True):
            inputs |= {group.queries: Tensor("int32", (None,)), group.members: Tensor("int32", (None, width))}
    return inputs, {"confidence": Tensor("float32", (None,)), "residuals": Tensor("float32", (None, 7))}


_: type[Pipeline[PreparedScan, FirstStageResult]] = RefinePipeline  # mypy compares them
