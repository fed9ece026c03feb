"""Both stages from training to boxes: checkpoint, bundle, runtime."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch

from asca_deploy import Detector
from asca_deploy.bundle import GRAPHS, PFN
from asca_deploy.golden import golden_stages
from asca_deploy.manifest import load_pillar_bundle
from asca_deploy.two_stage.pipeline import RefinePipeline
from asca_export.bundle_writer import ExportOptions
from asca_export.int8 import MAX_LOGIT_ERROR
from asca_export.pillar.export import export_pillar_bundle
from asca_export.two_stage.export import check_refine_parity, export_refine_bundle
from asca_export.two_stage.first_stage import open_exported
from asca_export.two_stage.graphs import fold_norms
from asca_pillars.base.errors import BundleError, ExportError
from asca_pillars.models.build import Checkpoint, build_model, load_checkpoint
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.models.two_stage.first_stage import with_first_stage
from asca_pillars.models.two_stage.network import RefineDetector
from asca_pillars.scans.input_check import ExpectedInput
from asca_pillars.training.loop import train
from tests.export.deployed import assert_same_detector, changed_manifest
from tests.export.sweeps import all_at_once
from tests.export.tiny import CALIBRATION, SCANS, tiny_checkpoint
from tests.helpers.made_once import made_once
from tests.helpers.saved_checkpoint import save_checkpoint
from tests.helpers.scenes import SPEC, write_dataset
from tests.models.two_stage.small_refiner import batch, small_refiner
from tests.models.two_stage.tiny_refine import opened_config, tiny_refine_config, write_first_stage


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A checkpoint of the second stage, and the bundle exported from it."""

    def make(folder: Path) -> None:
        config = tiny_refine_config(write_first_stage(folder / "first.ckpt"), learning_rate=1e-2)
        last = train(config, write_dataset(folder / "data", 5), folder / "run")
        export_refine_bundle(load_checkpoint(last), folder / "bundle", SCANS)

    folder = made_once(tmp_path_factory, "refine", make)
    return folder / "run" / "checkpoints" / "last.ckpt", folder / "bundle"


def on_first_stage(source: Path, trained: tuple[Path, Path]) -> Checkpoint:
    """The trained second stage on another first one: the graph of its network is there already."""
    config = opened_config(source)
    detector = build_model(config.model)
    detector.load_state_dict(load_checkpoint(trained[0]).detector.state_dict())
    return Checkpoint(config, detector.eval(), 0)


def test_golden_vectors_of_both_stages(trained: tuple[Path, Path]) -> None:
    detector = Detector(trained[1], score_threshold=0.0, threads=1)
    assert isinstance(detector.pipeline, RefinePipeline)
    stages = golden_stages(detector.pipeline, SCANS[0])
    assert list(stages)[-5:] == ["neck+head", "propose", "neighbors", "refine", "suppress"]
    assert stages["neck+head"]["neck"].shape[:2] == stages["neck+head"]["scores"].shape[:2]
    assert len(stages["refine"]["confidence"]) == len(stages["propose"]["boxes"]) > 0
    np.testing.assert_array_equal(stages["suppress"]["boxes"], detector(SCANS[0]).boxes)


def test_train_export_detect(trained: tuple[Path, Path], tmp_path: Path) -> None:
    last, folder = trained
    bundle = load_pillar_bundle(folder)
    assert (bundle.kind, set(bundle.graphs)) == ("pillar_refine", {PFN, *GRAPHS["pillar_refine"]})
    assert bundle.parity is not None and bundle.parity.scans == len(SCANS) and bundle.refine is not None
    assert_same_detector(load_checkpoint(last), folder)


def test_a_sparse_neck_on_a_pooled_map_proposes(trained: tuple[Path, Path], tmp_path: Path) -> None:
    """Expected input is that of the scans which the first stage was trained on."""
    spec = replace(SPEC, grid=replace(SPEC.grid, map="pooled"))
    revolutions = ExpectedInput((50_000, 60_000), (0.2, 0.3), (-1.8, -1.7), camera_view=False)
    first = tiny_checkpoint("channel", spec, neck="sparse")._replace(expected_input=revolutions)
    save_checkpoint(tmp_path / "first.ckpt", first)
    views = load_checkpoint(trained[0]).expected_input
    assert views is not None and views.camera_view
    checkpoint = on_first_stage(tmp_path / "first.ckpt", trained)._replace(expected_input=views)
    bundle = export_refine_bundle(checkpoint, tmp_path / "bundle", SCANS)
    assert (bundle.expected_input, bundle.expected_input_from) == (revolutions, "training")
    runtime = Detector(tmp_path / "bundle", score_threshold=0.0, threads=1)
    assert isinstance(runtime.pipeline, RefinePipeline)
    assert runtime.pipeline.stages[2] == "rulebooks" and len(runtime(SCANS[0])) > 0
    golden = golden_stages(runtime.pipeline, SCANS[0])
    assert len(golden["neck+head"]["cells"]) == len(golden["neck+head"]["neck"])
    np.testing.assert_array_equal(golden["suppress"]["boxes"], runtime(SCANS[0]).boxes)
    assert len(runtime(np.empty((0, 4), np.float32))) == 0


def test_the_first_stage_in_eight_bits(
    trained: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("asca_export.int8.sweep", all_at_once)
    checkpoint = load_checkpoint(trained[0])
    quantized = export_refine_bundle(
        checkpoint, tmp_path / "a", SCANS, ExportOptions(calibration=CALIBRATION, weights=trained[0])
    )
    assert load_checkpoint(tmp_path / "a" / "weights.ckpt").config == checkpoint.config
    assert (quantized.name, quantized.precision, quantized.kind) == ("tiny_refine", "int8", "pillar_refine")
    assert load_pillar_bundle(tmp_path / "a") == quantized
    report = quantized.quantization
    assert report is not None and report.boxes > 5 and report.boxes_matched > report.boxes / 2
    assert 0 < report.logit_rms_error <= MAX_LOGIT_ERROR
    floating, eight_bit = (Detector(folder, threads=1).pipeline for folder in (trained[1], tmp_path / "a"))
    assert isinstance(floating, RefinePipeline) and isinstance(eight_bit, RefinePipeline)
    one, other = (each.infer(each.prepare(SCANS[0], []), []).outputs.neck for each in (floating, eight_bit))
    stored = {node.name: node for node in onnx.load(tmp_path / "a/refine.onnx").graph.initializer}
    scaled = other * onnx.numpy_helper.to_array(stored["bev.factors"])
    assert other.dtype == np.float32 and 0 < np.abs(one - scaled).mean() < 0.1 * np.abs(one).mean()


def test_eight_bits_of_other_weights_are_refused(
    trained: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bundle's 8-bit form goes by its name; another network may stand there."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("asca_export.int8.sweep", all_at_once)
    save_checkpoint(Path("first.ckpt"), tiny_checkpoint("channel"))
    export_pillar_bundle(tiny_checkpoint("channel"), "first", SCANS, ExportOptions(weights=Path("first.ckpt")))
    checkpoint = on_first_stage(Path("first"), trained)
    with pytest.raises(ExportError, match="0 scans with points on the grid given to calibrate on, at least 8"):
        export_refine_bundle(checkpoint, "out", SCANS, ExportOptions(calibration=SCANS))
    with pytest.raises(BundleError, match="first_int8: no such folder"):
        export_refine_bundle(checkpoint, "out", SCANS, ExportOptions(calibration=CALIBRATION))
    other = tiny_checkpoint("channel")
    with torch.no_grad():
        assert isinstance(other.detector, PillarDetector)
        other.detector.head.scores.weight.mul_(-1)
    export_pillar_bundle(other, "first_int8", SCANS, ExportOptions(calibration=CALIBRATION))
    with pytest.raises(ExportError, match="it is not its 8-bit form"):
        export_refine_bundle(checkpoint, "out", SCANS, ExportOptions(calibration=CALIBRATION))
    assert not Path("out").exists()


def test_scans_with_little_or_nothing(trained: tuple[Path, Path]) -> None:
    detector = Detector(trained[1], score_threshold=0.0, threads=1)
    for points in (np.empty((0, 4)), np.array([[200, 0, 0, 0.5]]), np.array([[10, 0, -1, 0.5]])):
        assert np.isfinite(detector(points.astype(np.float32)).boxes).all()
    assert len(Detector(trained[1], score_threshold=1.0, threads=1)(SCANS[0])) == 0


def test_folded_norms_change_nothing() -> None:
    refiner, inputs = small_refiner(), batch((0, 1)).inputs
    refiner.train()
    with torch.no_grad():
        for _ in range(3):
            refiner(inputs)  # statistics that are not those of fresh weights
        expected, found = refiner.eval()(inputs), fold_norms(refiner)(inputs)
    for one, other in zip(expected, found, strict=True):
        torch.testing.assert_close(other, one, atol=1e-4, rtol=1e-4)
    assert any(isinstance(module, torch.nn.BatchNorm1d) for module in refiner.modules())
    assert not any(isinstance(module, torch.nn.BatchNorm1d) for module in fold_norms(refiner).modules())


def test_the_graph_needs_no_scatter_and_no_normalization(trained: tuple[Path, Path]) -> None:
    kinds = {node.op_type for node in onnx.load(trained[1] / "refine.onnx").graph.node}
    assert not kinds & {"BatchNormalization", "ScatterND", "ScatterElements", "NonZero", "Loop"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data["refine"]["seen"]["keypoints"].update(count=100), "`refine` is not the one that"),
        (lambda data: data["refine"].update(bev_channels=0), "bev_channels 0 must lie between"),
        (lambda data: data.pop("refine"), "`refine` is missing|`refine` is null"),
        (lambda data: data["refine"]["seen"]["proposals"].update(quotas=[1, 2]), "has not one for each class"),
        (lambda data: data["graphs"].pop("refine"), "has the graphs pfn and encoder and backbone and refine, not"),
        (lambda data: data.update(kind="pillar"), "`refine` belongs to kind pillar_refine"),
        (lambda data: data["pillar"].update(neck="sparse", active_cells="sub"), "`pillar` is not the one that"),
        (lambda data: data["spec"]["grid"].update(map="pooled"), "`spec` is not the one that"),
        (lambda data: data.update(precision="int8"), "`precision` is not the one that"),
    ],
)
def test_manifests_that_were_changed(
    trained: tuple[Path, Path], tmp_path: Path, change: Callable[[Any], object], message: str
) -> None:
    with pytest.raises(BundleError, match=message):
        load_pillar_bundle(changed_manifest(trained[1], tmp_path / "bundle", change))


def test_a_refiner_with_other_weights_is_no_parity(trained: tuple[Path, Path], tmp_path: Path) -> None:
    checkpoint, bundle = load_checkpoint(trained[0]), load_pillar_bundle(trained[1])
    detector, pipeline = checkpoint.detector, RefinePipeline(trained[1], bundle, threads=1)
    assert isinstance(detector, RefineDetector)
    model = with_first_stage(detector.model)
    stage = open_exported(model.first_stage)
    parity = check_refine_parity(detector.refiner, stage, pipeline, model, [np.empty((0, 4), np.float32), SCANS[0]])
    assert parity.scans == 1, "a scan without a point proves nothing"
    with torch.no_grad():
        for weight in detector.refiner.head.confidence.parameters():
            weight.fill_(torch.nan)
    with pytest.raises(ExportError, match="differ at stage refine `confidence`"):
        check_refine_parity(detector.refiner, stage, pipeline, model, SCANS[:1])
    with pytest.raises(ExportError, match="at least 8"):
        export_refine_bundle(checkpoint, tmp_path / "bundle", SCANS[:1])
