"""Quantization of a proven float bundle of PV-RCNN: the first stage in 8 bits.

The sparse backbone and the backbone on the map take most of the time and gain the most. Keypoints and proposals are
refined in float32: their graphs take positions in metres. They read the levels' real values and the map in steps.
"""

import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray

from asca_deploy.bundle import BACKBONE, KEYPOINTS, VOXELS, PvRcnnBundle
from asca_deploy.detector import Detector
from asca_deploy.pv_rcnn.graphs import OUT, VoxelCanvas, map_channels, voxel_inputs, voxels_interface
from asca_deploy.pv_rcnn.pipeline import PvRcnnPipeline
from asca_export.fast_forms import CanvasSteps, FastBackbone
from asca_export.graphs import graph_path
from asca_export.int8 import Points, RoundedMaps, calibration_scans, logit_error, sweep, write_quantized
from asca_export.pv_rcnn.graphs import RoundedVoxels, VoxelSample
from asca_export.quantize import STEPS
from asca_export.two_stage.graphs import scale_bev
from asca_pillars.base.errors import ExportError
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.models.pv_rcnn.layers import PvRcnn


def require_quantizable(model: PvRcnnModel) -> None:
    """Refuse what is not put in 8 bits.

    Raises:
        ExportError: the map's backbone has attention, whose results are not those of a ReLU.
    """
    if model.network.attention != "none":
        raise ExportError(
            f"model.network.attention {model.network.attention}: a backbone with attention cannot be quantized; "
            "leave --int8 out"
        )


def quantize_pv_rcnn_bundle(
    folder: Path,
    bundle: PvRcnnBundle,
    network: PvRcnn,
    calibration: Sequence[Points],
    scans: Sequence[Points],
    progress: Callable[[str], None] = lambda _: None,
) -> PvRcnnBundle:
    """Replace the first stage's graphs and the manifest in `folder` by 8-bit ones.

    Arguments and errors as of `int8.quantize_bundle`, the network in place of its detector.
    """
    chosen_scans = calibration_scans(calibration, scans, bundle.spec)
    runtime = Detector(folder)
    pipeline = runtime.pipeline
    assert isinstance(pipeline, PvRcnnPipeline), "the bundle has just been exported from PV-RCNN"
    seen = [points for points in scans if (bundle.spec.grid.cells(points) >= 0).any()]
    expected, boxes = list(_scores(pipeline, seen)), list(map(runtime, scans))
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(shutil.copytree(folder, Path(temporary) / "bundle"))
        progress("Calibrating and rounding the weights")
        voxels, maps, steps = _round(network, bundle, pipeline, chosen_scans.used, Path(temporary))
        eight_bit_form = replace(bundle, precision="int8")

        def write(eight_bit: Sequence[str]) -> None:
            for name, rounded in ((VOXELS, voxels), (BACKBONE, maps)):
                rounded.write(graph_path(work, name), [layer for layer in rounded.layers if layer in eight_bit])

        def error_of(eight_bit: Sequence[str]) -> float:
            write(eight_bit)
            trial = PvRcnnPipeline(work, eight_bit_form, threads=runtime.threads)
            return logit_error(expected, _scores(trial, seen), bundle.spec)

        layers = [*voxels.layers, *maps.layers]
        sweep_result = sweep(layers, error_of, progress)
        write([layer for layer in layers if layer not in sweep_result.kept_float])
        keypoints = scale_bev(onnx.load(graph_path(folder, KEYPOINTS)), steps.scale.numpy())
        onnx.save(keypoints, graph_path(work, KEYPOINTS))
        for name in (VOXELS, BACKBONE, KEYPOINTS):
            shutil.copyfile(graph_path(work, name), graph_path(folder, name))
    return write_quantized(folder, bundle, sweep_result.report(chosen_scans, len(scans)), boxes, scans)


def _round(
    network: PvRcnn, bundle: PvRcnnBundle, pipeline: PvRcnnPipeline, calibration: Sequence[Points], work: Path
) -> tuple[RoundedVoxels, RoundedMaps, CanvasSteps]:
    """Return both backbones with rounded weights, and the steps of the map between them."""
    voxelized = [pipeline.voxelize(points) for points in calibration]
    samples = [
        VoxelSample(
            torch.from_numpy(scan.features),
            {name: torch.from_numpy(rulebook) for name, rulebook in voxel_inputs(scan.features, scan.levels).items()},
        )
        for scan in voxelized
    ]
    voxels = RoundedVoxels(network.voxels, samples, list(voxels_interface(bundle)[1]))
    shape, channels = bundle.spec.level_shapes[-1], map_channels(bundle)
    scale = voxels.out_steps.repeat(shape[0])  # voxels of a column one above the other
    steps = CanvasSteps(scale, torch.zeros_like(scale))
    encoded = [np.round(pipeline.encode(scan)[OUT] / voxels.out_steps.numpy()) for scan in voxelized]
    whole = [np.clip(features, 0, STEPS).astype(np.uint8) for features in encoded]

    def canvases() -> Iterator[NDArray[np.uint8]]:
        canvas = VoxelCanvas(shape, channels, np.uint8)
        for features, scan in zip(whole, voxelized, strict=True):
            canvas.scatter(features, scan.levels[-1].cells)
            yield canvas.image

    maps = RoundedMaps(FastBackbone(network, steps, padded=False), canvases, steps, bundle.spec.map_shape, work)
    return voxels, maps, steps


def _scores(pipeline: PvRcnnPipeline, scans: Sequence[Points]) -> Iterator[NDArray[np.float32]]:
    for points in scans:
        maps = pipeline.infer(pipeline.prepare(points, []), []).maps
        assert maps is not None, "the scan has voxels"
        yield maps.scores
