"""Export of a PV-RCNN checkpoint to a bundle.

Parity with the trained model is proven graph by graph on the same inputs, then of the boxes.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from asca_deploy.bundle import BACKBONE, BUNDLE_FOLDER, Parity, PvRcnnBundle, PvRcnnSection
from asca_deploy.pv_rcnn.graphs import OUT, VoxelCanvas, balls_around
from asca_deploy.pv_rcnn.pipeline import PvRcnnPipeline
from asca_export import graphs
from asca_export.bundle_writer import DEFAULTS, ExportOptions, draft_bundle, require_parity_scans, write_bundle
from asca_export.int8 import calibration_scans
from asca_export.parity import require_close, require_compared, require_same_refined
from asca_export.pv_rcnn.graphs import export_pv_rcnn_graphs
from asca_export.pv_rcnn.int8 import quantize_pv_rcnn_bundle, require_quantizable
from asca_pillars.base.files import atomic_directory
from asca_pillars.base.system import default_threads
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.detection.proposals import propose_anchors
from asca_pillars.models.build import Checkpoint
from asca_pillars.models.pv_rcnn.layers import PvRcnn
from asca_pillars.models.pv_rcnn.network import PvRcnnDetector
from asca_pillars.models.pv_rcnn.preparation import VoxelBatch, batch_scans
from asca_pillars.ops.points.sampling import read_map
from asca_pillars.ops.pv_rcnn.prepare import LEVEL_SOURCES, voxel_scan
from asca_pillars.ops.two_stage.prepare import grid_neighbors

RELATIVE_TOLERANCE = 1e-4  # of a graph's outputs, relative to their largest value where that is above 1

Array = NDArray[np.float32]


def check_pv_rcnn_parity(network: PvRcnn, runtime: PvRcnnPipeline, scans: Sequence[Array]) -> Parity:
    """Compare every stage in PyTorch with the exported graph on what PyTorch gave for the stage before.

    A proposal that one side has and the other lacks, by a tie between scores, would hide what a graph does.

    Args:
        network: in evaluation mode.
        runtime: opened on the bundle.
        scans: (N, 4) each, at least one of them with points in the ranges.

    Raises:
        ExportError: they differ; names the first stage that does, and the scan.
    """
    worst = worst_box = worst_yaw = 0.0
    spec, builder, compared = network.spec, network.spec.rulebook_builder(), 0
    for number, points in enumerate(scans):
        scan = voxel_scan(points[np.isfinite(points).all(axis=1)], spec, network.settings, builder)
        if not len(scan.features):
            continue
        compared += 1
        batch = batch_scans([scan], spec)
        with torch.inference_mode():
            first = network.propose(batch)
            described, _ = network.encode_keypoints(batch, first.levels, first.canvas)
        levels = dict(zip((*LEVEL_SOURCES, OUT), (level.numpy() for level in first.levels), strict=True))
        for name, actual in runtime.encode(scan).items():
            worst = max(worst, _require(f"voxels `{name}`", levels[name], actual, number))
        canvas = VoxelCanvas(spec.level_shapes[-1], first.canvas.shape[3])
        canvas.scatter(levels[OUT], scan.levels[-1].cells)
        worst = max(worst, _require("scatter", first.canvas.numpy(), canvas.image, number))
        maps = HeadMaps(*(part[0].numpy() for part in first.maps))
        for name, expected, actual in zip(maps._fields, maps, runtime.neck_and_head(canvas.image), strict=True):
            worst = max(worst, _require(f"head `{name}`", expected, actual, number))
        bev = read_map(canvas.rows, scan.bev_cells, scan.bev_weights)
        features = described.numpy()
        places = _places(network, batch, first.levels)
        for name, actual in runtime.deform(scan, levels).items():
            worst = max(worst, _require(f"deform `{name}`", places[name], actual, number))
        # PyTorch's places for both sides: the last bit of one decides which voxels lie in its ball.
        actual = runtime.encode_keypoints(scan, levels, bev, places, balls_around(scan, network.settings, places))
        worst = max(worst, _require("keypoints", features, actual, number))
        proposals = propose_anchors(maps, spec, network.settings.proposals)
        grid = grid_neighbors(scan.keypoints, proposals.boxes, network.settings, network.settings.vector_cells)
        with torch.inference_mode():
            indices = [torch.from_numpy(part) for part in grid.indices]
            refined = network.refine(batch.keypoints, described, torch.from_numpy(grid.points), indices)
        in_torch = refined[0].numpy(), refined[1].numpy()
        in_runtime = runtime.refine(scan.keypoints, features, grid)
        for name, expected, actual in zip(("confidence", "residuals"), in_torch, in_runtime, strict=True):
            worst = max(worst, _require(f"refine `{name}`", expected, actual, number))
        difference = require_same_refined(proposals, in_torch, in_runtime, spec, runtime.scores, number)
        worst_box, worst_yaw = max(worst_box, difference.center_size_m), max(worst_yaw, difference.yaw_rad)
    return Parity(worst, worst_box, worst_yaw, require_compared(compared), RELATIVE_TOLERANCE)


def _places(network: PvRcnn, batch: VoxelBatch[torch.Tensor], levels: Sequence[torch.Tensor]) -> dict[str, Array]:
    """Return PyTorch's shifted keypoints by the names of the graph's outputs."""
    with torch.inference_mode():
        places = network.deformed_positions(batch, levels)
    return {
        f"{name}_place_{number}": place.numpy()
        for name, indices in places.items()
        for number, place in enumerate(indices)
    }


def _require(stage: str, expected: Array, actual: Array, scan: int) -> float:
    """Return the largest difference, relative to the largest value where that is above 1."""
    scale = max(1.0, float(np.abs(expected).max(initial=0.0)))
    return require_close(stage, expected, actual, RELATIVE_TOLERANCE * scale, scan) / scale


def export_pv_rcnn_bundle(
    checkpoint: Checkpoint,
    out: str | Path,
    scans: Sequence[NDArray[np.float32]],
    options: ExportOptions = DEFAULTS,
) -> PvRcnnBundle:
    """Export kind pv_rcnn, see `asca_export.export.export_bundle`: four graphs.

    With `options.calibration` the first stage is put in 8 bits; what follows the proposals stays in float32.
    """
    model, detector, calibration = checkpoint.config.model, checkpoint.detector, options.calibration
    assert isinstance(model, PvRcnnModel) and isinstance(detector, PvRcnnDetector), "it is of kind pv_rcnn"
    require_parity_scans(scans)
    if calibration is not None:
        require_quantizable(model)
        calibration_scans(calibration, scans, model.spec)  # too few are told before the work, not after it
    options.progress("Exporting and proving parity")
    with atomic_directory(out, *BUNDLE_FOLDER) as folder:
        network = model.network
        section = PvRcnnSection(network.voxel_channels, network.keypoint_channels, model.settings, model.scores)
        draft = draft_bundle(
            PvRcnnBundle, model.spec, checkpoint, scans, options, kind="pv_rcnn", pv_rcnn=section, backbone_gmac=0.0
        )
        export_pv_rcnn_graphs(detector.network, draft, folder)
        gmac = graphs.multiply_accumulates(graphs.graph_path(folder, BACKBONE)) / 1e9

        def compare(opened: PvRcnnBundle) -> Parity:
            pipeline = PvRcnnPipeline(folder, opened, threads=default_threads())
            return check_pv_rcnn_parity(detector.network, pipeline, scans)

        bundle = write_bundle(folder, dataclasses.replace(draft, backbone_gmac=gmac), compare, options.weights)
        if calibration is not None:
            bundle = quantize_pv_rcnn_bundle(folder, bundle, detector.network, calibration, scans, options.progress)
    return bundle
