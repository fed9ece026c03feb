"""PV-RCNN with its first stage in 8 bits, from the checkpoint to boxes."""

import dataclasses
import shutil
from collections import defaultdict
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import numpy_helper

from asca_deploy import Detector
from asca_deploy.bundle import KEYPOINTS, REFINE, PvRcnnBundle
from asca_deploy.manifest import load_bundle, write_bundle_manifest
from asca_deploy.pv_rcnn.graphs import OUT, voxel_inputs
from asca_deploy.pv_rcnn.pipeline import PvRcnnPipeline
from asca_export import graphs, int8
from asca_export.bundle_writer import ExportOptions
from asca_export.int8 import logit_error
from asca_export.pv_rcnn.export import export_pv_rcnn_bundle
from asca_export.pv_rcnn.graphs import VoxelProducts, VoxelSample, scale_voxels_to_steps
from asca_export.pv_rcnn.int8 import quantize_pv_rcnn_bundle
from asca_pillars.base.errors import BundleError, ExportError
from asca_pillars.models.build import Checkpoint
from asca_pillars.models.pv_rcnn.network import PvRcnnDetector
from tests.export.pv_rcnn.random_checkpoint import CALIBRATION, random_checkpoint
from tests.export.sweeps import remembered
from tests.export.tiny import SCANS
from tests.helpers.made_once import made_once
from tests.models.pv_rcnn.tiny_pv_rcnn import MODEL, NETWORK, SPEC, batch, frame, tiny_config, tiny_detector

LAYERS = 11 + 2 * 2 + 2 + 1
"""Of 12 products over voxels all but the first; the two blocks, their upsamplings, the head."""

COMPARED = SCANS[:4]


def quantize(folder: Path, copy: Path) -> PvRcnnBundle:
    """The second half of such an export, on a copy of a proven float bundle."""
    bundle, detector = load_bundle(shutil.copytree(folder, copy)), random_checkpoint().detector
    assert isinstance(bundle, PvRcnnBundle) and isinstance(detector, PvRcnnDetector)
    # Two of the compared scans are given to calibrate on as well.
    calibration = [*CALIBRATION, COMPARED[2], COMPARED[0].copy()]
    return quantize_pv_rcnn_bundle(copy, bundle, detector.network, calibration, COMPARED)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The bundle in float32 and in 8 bits."""

    def make(folder: Path) -> None:
        export_pv_rcnn_bundle(random_checkpoint(), folder / "float", SCANS)
        quantize(folder / "float", folder / "int8")

    folder = made_once(tmp_path_factory, "pv_rcnn_int8", make)
    return folder / "float", folder / "int8"


def opened(folder: Path) -> tuple[Detector, PvRcnnPipeline]:
    detector = Detector(folder, threads=1)
    assert isinstance(detector.pipeline, PvRcnnPipeline)
    return detector, detector.pipeline


def test_the_bundle_says_what_it_is(folders: tuple[Path, Path]) -> None:
    bundle = load_bundle(folders[1])
    assert isinstance(bundle, PvRcnnBundle)
    assert (bundle.name, bundle.precision) == ("tiny_pv_rcnn", "int8")
    report = bundle.quantization
    assert report is not None and bundle.parity is not None
    assert (report.calibration_scans, report.dropped_scans, report.compared_scans) == (8, 2, 4)
    assert len(report.layers) == LAYERS and not any(layer.kept_float for layer in report.layers)
    assert 0 < report.logit_rms_error <= int8.MAX_LOGIT_ERROR
    assert report.boxes > 10
    assert report.boxes_matched > 0.6 * report.boxes, "proposals of random weights have almost equal scores"
    assert Detector(folders[1]).runs_on == "cpu int8"


def test_its_report_by_both_bundles(folders: tuple[Path, Path]) -> None:
    (exact, floating), (_, eight_bit) = (opened(folder) for folder in folders)
    scores = []
    for pipeline in (floating, eight_bit):
        maps = [pipeline.infer(pipeline.prepare(points, []), []).maps for points in COMPARED]
        scores.append([each.scores for each in maps if each is not None])
    report = load_bundle(folders[1]).quantization
    assert report is not None
    assert logit_error(scores[0], iter(scores[1]), SPEC) == pytest.approx(report.logit_rms_error, rel=1e-3)
    assert sum(len(exact(points)) for points in COMPARED) == report.boxes


def test_graphs_multiply_in_8_bits_and_the_second_stage_does_not(folders: tuple[Path, Path]) -> None:
    weights = 0
    for name in ("voxels", "backbone"):
        graph = onnx.load(folders[1] / f"{name}.onnx").graph
        tensors = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
        for key, tensor in tensors.items():
            if tensor.dtype == np.int8 and tensor.ndim > 1:
                assert 60 < np.abs(tensor.astype(int)).max() <= 64, key
                weights += 1
        floats = [key for key, tensor in tensors.items() if tensor.dtype == np.float32 and tensor.ndim > 1]
        assert floats == (["conv1_0.missing", "conv1_0.weight"] if name == "voxels" else [])
    assert weights == LAYERS
    for name in (KEYPOINTS, REFINE):
        kinds = {node.op_type for node in onnx.load(folders[1] / f"{name}.onnx").graph.node}
        assert "DequantizeLinear" not in kinds, name
    sizes = [sum(path.stat().st_size for path in folder.glob("[vb]*.onnx")) for folder in folders]
    assert sizes[1] < sizes[0]


def test_what_the_second_stage_reads_is_what_it_was(folders: tuple[Path, Path]) -> None:
    (_, floating), (_, eight_bit) = (opened(folder) for folder in folders)
    errors = []
    for points in SCANS[:3]:
        expected, found = (pipeline.prepare(points, []) for pipeline in (floating, eight_bit))
        assert expected.canvas is not None and found.canvas is not None and found.canvas.image.dtype == np.uint8
        for name, level in expected.levels.items():
            error = np.sqrt(np.square(found.levels[name] - level).mean()) / level.std()
            assert found.levels[name].dtype == np.float32 and error < 0.1, name
        first = [pipeline.infer(each, []) for pipeline, each in ((floating, expected), (eight_bit, found))]
        features = [
            pipeline.encode_keypoints(each.scan, each.levels, each.bev, {}, each.scan.ball_indices)
            for pipeline, each in zip((floating, eight_bit), first, strict=True)
        ]
        errors.append(np.sqrt(np.square(features[1] - features[0]).mean()) / features[0].std())
    assert max(errors) < 0.1


@pytest.mark.parametrize("name", ["voxels", "backbone"])
def test_onnxruntime_computes_what_the_graph_says(folders: tuple[Path, Path], name: str) -> None:
    """Its 8-bit kernels against its float ones on the dequantized graph: saturation would differ by a lot."""
    _, pipeline = opened(folders[1])
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    path = folders[1] / f"{name}.onnx"
    plain = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    errors = defaultdict(list)
    for points in SCANS:
        prepared = pipeline.prepare(points, [])
        assert prepared.canvas is not None
        if name == "voxels":
            found = pipeline.encode(prepared.scan)
            given = voxel_inputs(prepared.scan.features, prepared.scan.levels)
        else:
            given = {"canvas": prepared.canvas.image}
            found = pipeline.neck_and_head(prepared.canvas.image)._asdict()
        for output, values in found.items():
            (expected,) = plain.run([output], given)
            expected = expected if name == "voxels" else np.moveaxis(expected[0], -1, 0)
            error = expected.astype(np.float64) - values
            errors[output].append(np.sqrt(np.square(error).mean()) / expected.std())
    # One value in the middle between two steps may round either way. Of 29 other weights and three scans each four
    # scans had one, of these eight scans two; each layer then spreads it, to a quarter of the rows of the last and to
    # 2 % here. The scans without are the same.
    for output, of_scans in errors.items():
        assert np.median(of_scans) < 1e-5 and max(of_scans) < 0.03, (output, of_scans)


def test_scans_with_little_or_nothing_and_a_stream(folders: tuple[Path, Path]) -> None:
    detector, _ = opened(folders[1])
    alone = [detector(points) for points in SCANS]
    for points in (np.empty((0, 4)), np.array([[200, 0, 0, 0.5]]), np.array([[10, 0, -1, 0.5]])):
        assert np.isfinite(detector(points.astype(np.float32)).boxes).all()
    for found, expected in zip(detector.stream(SCANS), alone, strict=True):
        np.testing.assert_array_equal(found.boxes, expected.boxes)


def test_steps_change_nothing_before_they_are_rounded() -> None:
    detector = random_checkpoint().detector
    assert isinstance(detector, PvRcnnDetector)
    samples = []
    for seed in (1, 2):
        scans = batch(detector, frame(seed)).scans
        rulebooks = {f"same_{number}": level.same for number, level in enumerate(scans.levels[:-1])}
        rulebooks |= {f"strided_{number}": level.strided for number, level in enumerate(scans.levels) if number}
        samples.append(VoxelSample(scans.features, rulebooks))
        with torch.inference_mode():
            expected = detector.network.voxels(scans.features, scans.levels)
    products = VoxelProducts(detector.network.voxels)
    steps = scale_voxels_to_steps(products, samples)
    found = {name: output for name, _, output in products.passes(*samples[-1])}
    for level, values in zip(("conv1", "conv2", "conv3", "conv4", OUT), expected, strict=True):
        name = products.last_of(level)
        torch.testing.assert_close(found[name] * 64 * steps[name], values, rtol=1e-3, atol=1e-4)
        assert found[name].max() <= 255 / 64 * 1.0001


def test_layers_that_hurt_stay_in_floating_point(
    folders: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = load_bundle(folders[1]).quantization
    assert whole is not None
    monkeypatch.setattr(int8, "MAX_LOGIT_ERROR", 0.9 * whole.logit_rms_error)
    known = {layer.layer: layer.logit_rms_error for layer in whole.layers}
    monkeypatch.setattr("asca_export.pv_rcnn.int8.sweep", remembered(known))
    report = quantize(folders[0], tmp_path / "bundle").quantization
    assert report is not None and report.logit_rms_error <= 0.9 * whole.logit_rms_error
    assert 0 < sum(layer.kept_float for layer in report.layers) < LAYERS
    # The runtime must not turn them into 8-bit ones behind our back.
    assert len(Detector(tmp_path / "bundle")(SCANS[0])) > 2


def test_what_is_not_put_in_8_bits(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="8 were left out because parity is proven on them"):
        export_pv_rcnn_bundle(random_checkpoint(), tmp_path / "bundle", SCANS, ExportOptions(calibration=SCANS))
    model = dataclasses.replace(MODEL, network=dataclasses.replace(NETWORK, attention="rda"))
    attentive = Checkpoint(tiny_config(model), tiny_detector(network=model.network).eval(), 0)
    with pytest.raises(ExportError, match=r"model\.network\.attention rda: .* leave --int8 out"):
        export_pv_rcnn_bundle(attentive, tmp_path / "bundle", SCANS, ExportOptions(calibration=CALIBRATION))
    assert not list(tmp_path.iterdir())


def test_a_manifest_of_another_precision(folders: tuple[Path, Path], tmp_path: Path) -> None:
    """Graphs in float32 whose manifest and stamps say 8 bits are refused by what they take."""
    copied = load_bundle(shutil.copytree(folders[0], tmp_path / "bundle"))
    signed = graphs.sign(tmp_path / "bundle", dataclasses.replace(copied, precision="int8"))
    write_bundle_manifest(tmp_path / "bundle", signed)
    with pytest.raises(BundleError, match=r"voxels\.onnx: output `out` is float32 .* needs uint8"):
        Detector(tmp_path / "bundle")
