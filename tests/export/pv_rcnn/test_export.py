"""PV-RCNN from training to boxes: checkpoint, bundle, runtime."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from asca_deploy import Detector
from asca_deploy.bundle import DEFORM, GRAPHS, PvRcnnBundle, PvRcnnSection
from asca_deploy.manifest import load_bundle, load_pillar_bundle
from asca_deploy.pv_rcnn.graphs import VoxelCanvas, balls_around, deform_inputs, keeps_memory
from asca_deploy.pv_rcnn.pipeline import PvRcnnPipeline
from asca_export.pv_rcnn.export import check_pv_rcnn_parity, export_pv_rcnn_bundle
from asca_export.pv_rcnn.graphs import export_deform
from asca_pillars.base.errors import BundleError, ExportError
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.config.tree import load_config
from asca_pillars.models.build import Checkpoint, load_checkpoint
from asca_pillars.models.pv_rcnn.network import PvRcnnDetector
from asca_pillars.models.pv_rcnn.preparation import batch_scans
from asca_pillars.ops.pv_rcnn.prepare import SourceBalls, voxel_scan
from asca_pillars.training.loop import train
from tests.export.deployed import assert_same_detector, changed_manifest
from tests.export.tiny import SCANS
from tests.helpers.made_once import made_once
from tests.helpers.scenes import write_dataset
from tests.models.pv_rcnn.tiny_pv_rcnn import EVERYTHING, MODEL, NETWORK, SETTINGS, SPEC, tiny_config, tiny_detector

Trained = tuple[Checkpoint, Path]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """A trained checkpoint with every module that the papers add, and the bundle exported from it."""

    def make(folder: Path) -> None:
        settings = dataclasses.replace(EVERYTHING["settings"], scale_samples=2)
        config = tiny_config(dataclasses.replace(MODEL, **EVERYTHING | {"settings": settings}), epochs=1)
        last = train(config, write_dataset(folder / "data", 5), folder / "run")
        export_pv_rcnn_bundle(load_checkpoint(last), folder / "bundle", SCANS)

    folder = made_once(tmp_path_factory, "pv_rcnn", make)
    return load_checkpoint(folder / "run" / "checkpoints" / "last.ckpt"), folder / "bundle"


def test_train_export_detect(trained: Trained, tmp_path: Path) -> None:
    checkpoint, folder = trained
    bundle = load_bundle(folder)
    assert isinstance(bundle, PvRcnnBundle) and set(bundle.graphs) == {*GRAPHS["pv_rcnn"], DEFORM}
    assert bundle.parity is not None and bundle.parity.scans == len(SCANS) and bundle.backbone_gmac > 0
    assert_same_detector(checkpoint, folder)


def test_more_threads_change_no_bit(trained: Trained) -> None:
    one, several = (Detector(trained[1], score_threshold=0.0, threads=count) for count in (1, 4))
    expected = one(SCANS[0])
    for _ in range(3):
        found = several(SCANS[0])
        np.testing.assert_array_equal(found.boxes, expected.boxes)
        np.testing.assert_array_equal(found.scores, expected.scores)


def test_scans_with_little_or_nothing(trained: Trained) -> None:
    detector = Detector(trained[1], score_threshold=0.0, threads=1)
    counts = []
    for points in (np.empty((0, 4)), np.array([[200, 0, 0, 0.5]]), np.array([[10, 0, -1, 0.5]])):
        found = detector(points.astype(np.float32))
        assert np.isfinite(found.boxes).all() and set(found.report.times_ms) == {"input", *detector.pipeline.stages}
        counts.append(len(found))
    assert counts[:2] == [0, 0] and counts[2] > 0
    assert len(Detector(trained[1], score_threshold=1.0, threads=1)(SCANS[0])) == 0


def test_graphs_scatter_nothing_and_have_no_normalization(trained: Trained) -> None:
    for name in (*GRAPHS["pv_rcnn"], DEFORM):
        kinds = {node.op_type for node in onnx.load(trained[1] / f"{name}.onnx").graph.node}
        assert not kinds & {"BatchNormalization", "ScatterND", "ScatterElements", "NonZero", "Loop"}, name


def test_a_canvas_forgets_the_scan_before() -> None:
    canvas = VoxelCanvas((2, 3, 4), 6)
    for cells in ([0, 5, 23], [1, 5], []):
        features = np.random.default_rng(0).random((len(cells), 3)).astype(np.float32)
        canvas.scatter(features, np.array(cells, np.int64))
        expected = np.zeros((24, 3), np.float32)
        expected[cells] = features
        np.testing.assert_array_equal(canvas.image.reshape(24, 3), expected)
    assert np.shares_memory(canvas.rows, canvas.image) and canvas.rows.shape == (12, 6)


def test_large_networks_give_their_memory_back() -> None:
    kept = {}
    for name in ("pv_rcnn_kitti", "pvrcnn_small_sim"):
        model = load_config(name).model
        assert isinstance(model, PvRcnnModel)
        network = model.network
        kept[name] = keeps_memory(
            PvRcnnSection(network.voxel_channels, network.keypoint_channels, model.settings, model.scores)
        )
    assert kept == {"pv_rcnn_kitti": False, "pvrcnn_small_sim": True}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data["pv_rcnn"]["settings"].update(keypoints=100), "`pv_rcnn` is not the one that"),
        (lambda data: data["pv_rcnn"].update(keypoint_channels=0), "channels 0 must lie between"),
        (lambda data: data.pop("pv_rcnn"), "`pv_rcnn`"),
        (lambda data: data["graphs"].pop("keypoints"), "has the graphs voxels and backbone and keypoints and refine"),
        (lambda data: data.update(kind="pillar"), "unknown key `spec.grid.size_m`"),
    ],
)
def test_manifests_that_were_changed(
    trained: Trained, tmp_path: Path, change: Callable[[Any], object], message: str
) -> None:
    with pytest.raises(BundleError, match=message):
        load_bundle(changed_manifest(trained[1], tmp_path / "bundle", change))


def test_a_pillar_detector_is_another_kind(trained: Trained, tmp_path: Path) -> None:
    with pytest.raises(BundleError, match="kind pv_rcnn, where one of a pillar detector is needed"):
        load_pillar_bundle(trained[1])
    with pytest.raises(ExportError, match="at least 8"):
        export_pv_rcnn_bundle(trained[0], tmp_path / "bundle", SCANS[:1])


@pytest.mark.parametrize(
    ("part", "stage"),
    [
        ("voxels.down.1.norm.bias", "voxels `conv3`|voxels `conv4`|voxels `out`"),
        ("neck.blocks.1.1.bias", "head `scores`"),
        ("encode.fuse.1.bias", "keypoints"),
        ("deform.conv4.align.weight", "deform `conv4_place_0`"),
        ("refine.shared.1.bias", "refine `confidence`"),
    ],
)
def test_other_weights_are_no_parity(trained: Trained, part: str, stage: str) -> None:
    checkpoint, folder = trained
    bundle, detector = load_bundle(folder), checkpoint.detector
    assert isinstance(bundle, PvRcnnBundle) and isinstance(detector, PvRcnnDetector)
    weight = detector.network.get_parameter(part)
    kept = weight.detach().clone()
    try:
        with torch.no_grad():
            weight.add_(0.5)
        with pytest.raises(ExportError, match=f"differ at stage ({stage})"):
            check_pv_rcnn_parity(detector.network, PvRcnnPipeline(folder, bundle), SCANS[:1])
    finally:
        with torch.no_grad():
            weight.copy_(kept)
    with pytest.raises(ExportError, match="none of the scans"):
        check_pv_rcnn_parity(detector.network, PvRcnnPipeline(folder, bundle), [np.empty((0, 4), np.float32)])


def test_a_place_for_each_radius(trained: Trained, tmp_path: Path) -> None:
    bundle = load_bundle(trained[1])
    assert isinstance(bundle, PvRcnnBundle)
    settings = dataclasses.replace(
        SETTINGS, sources=(SETTINGS.sources[0], SourceBalls("conv2", (0.8, 1.6), (4, 6))), deform="authors"
    )
    bundle = dataclasses.replace(bundle, pv_rcnn=dataclasses.replace(bundle.pv_rcnn, settings=settings))
    widths = dataclasses.replace(NETWORK, source_widths=((8, 8), (8, 8)))
    network = tiny_detector(settings=settings, network=widths).eval().network
    export_deform(network, bundle, tmp_path / "deform.onnx")
    scan = voxel_scan(SCANS[0], SPEC, settings, SPEC.rulebook_builder())
    batch = batch_scans([scan], SPEC)
    with torch.inference_mode():
        levels = network.propose(batch).levels
        expected = network.deformed_positions(batch, levels)["conv2"]
    session = onnxruntime.InferenceSession(tmp_path / "deform.onnx", providers=["CPUExecutionProvider"])
    given = deform_inputs(scan, settings, {"conv2": levels[1].numpy()})
    found = session.run(None, {each.name: given[each.name] for each in session.get_inputs()})
    assert [each.name for each in session.get_outputs()] == ["conv2_place_0", "conv2_place_1"]
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other.numpy(), atol=1e-5)
        assert np.abs(one - scan.keypoints).max() > 1e-3
    balls = balls_around(scan, settings, dict(zip(("conv2_place_0", "conv2_place_1"), found, strict=True)))
    assert balls[0] == list(scan.ball_indices[0]) and [index.shape for index in balls[1]] == [(96, 4), (96, 6)]
