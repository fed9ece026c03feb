"""Pipeline of kind pv_rcnn: proposals from voxels, refinement by keypoints (PV-RCNN, section 3)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_deploy import providers
from asca_deploy.bundle import BACKBONE, DEFORM, KEYPOINTS, REFINE, VOXELS, PvRcnnBundle
from asca_deploy.graph import Interface, Session, check_interface
from asca_deploy.pillar.pipeline import channels_first, run_graph, take_or_create
from asca_deploy.pipeline import Pipeline, StageTimes
from asca_deploy.pv_rcnn.graphs import (
    OUT,
    VoxelCanvas,
    backbone_interface,
    balls_around,
    deform_inputs,
    deform_interface,
    keeps_memory,
    keypoint_inputs,
    keypoints_interface,
    map_channels,
    map_type,
    refine_interface,
    voxel_inputs,
    voxels_interface,
)
from asca_deploy.two_stage.pipeline import OUTPUTS
from asca_pillars.base.kernels import load_kernels
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.detection.detections import Detections, ScanCounts
from asca_pillars.detection.proposals import propose_anchors
from asca_pillars.ops.points import neighbors, sampling
from asca_pillars.ops.points.sampling import read_map
from asca_pillars.ops.pv_rcnn import voxels
from asca_pillars.ops.pv_rcnn.prepare import VoxelizedScan, VoxelScan, voxel_levels, with_neighbors
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec
from asca_pillars.ops.sparse import rulebooks
from asca_pillars.ops.two_stage.decode import reported_detections
from asca_pillars.ops.two_stage.prepare import GridNeighbors, grid_neighbors


class PreparedVoxels(NamedTuple):
    """A scan whose voxels are encoded and scattered."""

    scan: VoxelScan
    levels: dict[str, NDArray[np.float32]]
    """Features (N, C) of the voxels of each level that keypoints aggregate, by the names of sources."""
    canvas: VoxelCanvas | None
    """None for a scan without voxels."""

    @property
    def counts(self) -> ScanCounts:
        """Counts of the scan's points."""
        return self.scan.counts


class VoxelOutputs(NamedTuple):
    """Outputs of the first stage for one scan."""

    scan: VoxelScan
    levels: dict[str, NDArray[np.float32]]
    bev: NDArray[np.float32]
    """(K, C) features of the bird's-eye-view map at the keypoints, in steps where the map is."""
    maps: HeadMaps[NDArray[np.float32]] | None
    """(channels, H, W); None of a scan without voxels."""


class PvRcnnPipeline:
    """See `pipeline.Pipeline`.

    `provider` and `precision` are the map backbone's; the other graphs have rows of any number or take positions in
    metres, so they run on onnxruntime's CPU provider, the sparse backbone of an 8-bit bundle in 8 bits. Tables and
    canvases are built in memory that is kept from scan to scan, as much as threads ever used at once.

    Args:
        folder: of the bundle.
        bundle: its manifest, verified by `load_bundle`.
        provider, precision, threads: of the backbone; the other graphs have as many threads.

    Raises:
        BundleError: a graph cannot be run or does not match the manifest.
        ProviderError: the provider does not start.
    """

    stages = ("voxelize", "neighbors", "voxels", "scatter", "neck+head", "propose", "keypoints", "refine", "decode")
    network_stages = ("voxels", "neck+head", "keypoints", "refine")

    def __init__(
        self,
        folder: Path,
        bundle: PvRcnnBundle,
        provider: providers.Provider = "cpu",
        precision: providers.Precision = "float32",
        threads: int = 1,
    ) -> None:
        for kernels in (neighbors.KERNELS, sampling.KERNELS, rulebooks.KERNELS, voxels.KERNELS):
            load_kernels(kernels)  # here rather than in the first scan
        self.spec: VoxelSpec = bundle.spec
        self.settings, self.scores = bundle.pv_rcnn.settings, bundle.pv_rcnn.scores

        def opened(
            name: str,
            interface: Interface,
            where: providers.Provider = "cpu",
            digits: providers.Precision = "float32",
        ) -> Session:
            path = folder / bundle.graphs[name].file
            session = providers.open_session(path, where, digits, threads, keep_memory=keeps_memory(bundle.pv_rcnn))
            return check_interface(path, session, *interface)

        self._voxels = opened(VOXELS, voxels_interface(bundle))
        self._backbone = opened(BACKBONE, backbone_interface(bundle), provider, precision)
        self._keypoints = opened(KEYPOINTS, keypoints_interface(bundle))
        self._refine = opened(REFINE, refine_interface(bundle))
        self._deform = opened(DEFORM, deform_interface(bundle)) if self.settings.deformed else None
        self._map_channels, self._map_type = map_channels(bundle), map_type(bundle)
        self._canvases = [self._new_canvas()]
        self._builders = [self.spec.rulebook_builder()]

    def prepare(self, points: NDArray[np.float32], stage_times: StageTimes) -> PreparedVoxels:
        """Prepare the bird's-eye-view map from points (N, 4), metres, LiDAR frame, and reflectance."""
        voxelized = self.voxelize(points)
        stage_times.append(("voxelize", perf_counter()))
        scan = with_neighbors(points, voxelized, self.spec, self.settings)
        stage_times.append(("neighbors", perf_counter()))
        if not len(scan.features):
            return PreparedVoxels(scan, {}, None)
        levels = self.encode(scan)
        stage_times.append(("voxels", perf_counter()))
        canvas = take_or_create(self._canvases, self._new_canvas)
        canvas.scatter(levels.pop(OUT), scan.levels[-1].cells)
        stage_times.append(("scatter", perf_counter()))
        return PreparedVoxels(scan, levels, canvas)

    def infer(self, prepared: PreparedVoxels, stage_times: StageTimes) -> VoxelOutputs:
        """Run neck and head on the map; return the head maps, and the map's features at the keypoints."""
        scan, levels, canvas = prepared
        if canvas is None:
            return VoxelOutputs(scan, levels, np.empty((0, self._map_channels), np.float32), None)
        maps = self.neck_and_head(canvas.image)
        stage_times.append(("neck+head", perf_counter()))
        bev = read_map(canvas.rows, scan.bev_cells, scan.bev_weights)
        self._canvases.append(canvas)
        stage_times.append(("keypoints", perf_counter()))
        return VoxelOutputs(scan, levels, bev, maps)

    def finish(self, raw: VoxelOutputs, stage_times: StageTimes) -> Detections:
        """Decode proposals, refine them, and return the boxes that thresholds and rotated NMS keep."""
        if raw.maps is None:
            return Detections.empty(self.spec.class_names)
        detections = reported_detections(*self.propose_and_refine(raw.maps, raw, stage_times), self.spec, self.scores)
        stage_times.append(("decode", perf_counter()))
        return detections

    def propose_and_refine(
        self, maps: HeadMaps[NDArray[np.float32]], raw: VoxelOutputs, stage_times: StageTimes
    ) -> tuple[Detections, NDArray[np.float32], NDArray[np.float32]]:
        """Return the R proposals of head maps, and the second stage's logits (R,) and residuals (R, 7) for them."""
        proposals = propose_anchors(maps, self.spec, self.settings.proposals)
        stage_times.append(("propose", perf_counter()))
        places = self.deform(raw.scan, raw.levels)
        stage_times.append(("keypoints", perf_counter()))
        balls = balls_around(raw.scan, self.settings, places)
        stage_times.append(("neighbors", perf_counter()))
        features = self.encode_keypoints(raw.scan, raw.levels, raw.bev, places, balls)
        stage_times.append(("keypoints", perf_counter()))
        grid = grid_neighbors(raw.scan.keypoints, proposals.boxes, self.settings, self.settings.vector_cells)
        stage_times.append(("neighbors", perf_counter()))
        confidence, residuals = self.refine(raw.scan.keypoints, features, grid)
        stage_times.append(("refine", perf_counter()))
        return proposals, confidence, residuals

    def voxelize(self, points: NDArray[np.float32]) -> VoxelizedScan:
        """Voxelize points (N, 4), metres, LiDAR frame, and reflectance: the input of voxels.onnx."""
        builder = take_or_create(self._builders, self.spec.rulebook_builder)
        voxelized = voxel_levels(points, self.spec, builder)
        self._builders.append(builder)
        return voxelized

    def encode(self, scan: VoxelScan | VoxelizedScan) -> dict[str, NDArray[Any]]:
        """Return features (N, C) of the voxels of every level that is read, by name; at least one voxel.

        Those of OUT are whole steps where the map is.
        """
        names = list(self._voxels.outputs)
        return dict(zip(names, run_graph(self._voxels, names, voxel_inputs(scan.features, scan.levels)), strict=True))

    def neck_and_head(self, canvas: NDArray[Any]) -> HeadMaps[NDArray[np.float32]]:
        """Run neck and head on (1, H, W, C): scores (A * classes, H, W), boxes (7A, H, W), directions (2A, H, W)."""
        return channels_first(self._backbone.run(HeadMaps._fields, {"canvas": canvas}))

    def deform(self, scan: VoxelScan, levels: Mapping[str, NDArray[np.float32]]) -> dict[str, NDArray[np.float32]]:
        """Return shifted positions (K, 3), metres, for levels with features (N, C), by name; empty without shifts."""
        if self._deform is None:
            return {}
        names = list(self._deform.outputs)
        return dict(zip(names, run_graph(self._deform, names, deform_inputs(scan, self.settings, levels)), strict=True))

    def encode_keypoints(
        self,
        scan: VoxelScan,
        levels: Mapping[str, NDArray[np.float32]],
        bev: NDArray[np.float32],
        places: Mapping[str, NDArray[np.float32]],
        balls: Sequence[Sequence[NDArray[np.int32]]],
    ) -> NDArray[np.float32]:
        """Return weighted features (K, C) of the keypoints.

        Args:
            scan: with the keypoints.
            levels: features (N, C) by name.
            bev: (K, C) the map at the keypoints.
            places: what `deform` gave.
            balls: what `balls_around` gave.
        """
        given = keypoint_inputs(scan, self.settings.sources, levels, bev, balls) | dict(places)
        return run_graph(self._keypoints, ["features"], given)[0]

    def refine(
        self, keypoints: NDArray[np.float32], features: NDArray[np.float32], grid: GridNeighbors
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return confidence logits (R,) and residuals (R, 7) of the proposals with this grid; keypoints (K, 3)."""
        if not len(grid.points):
            return np.empty(0, np.float32), np.empty((0, 7), np.float32)
        grids = {f"grid_{number}": indices for number, indices in enumerate(grid.indices)}
        given = {"keypoints": keypoints, "features": features, "grid_points": grid.points, **grids}
        confidence, residuals = run_graph(self._refine, OUTPUTS, given)
        return confidence, residuals

    def _new_canvas(self) -> VoxelCanvas:
        return VoxelCanvas(self.spec.level_shapes[-1], self._map_channels, self._map_type)


_: type[Pipeline[PreparedVoxels, VoxelOutputs]] = PvRcnnPipeline  # mypy compares them
