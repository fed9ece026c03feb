"""A pooled map from the checkpoint to boxes, with both necks: PyTorch and the runtime pool alike."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import onnx
import pytest

from asca_deploy import Detector
from asca_deploy.manifest import load_pillar_bundle
from asca_export.int8 import quantize_bundle
from asca_export.pillar.export import export_pillar_bundle
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.models.scan_detector import ScanDetector
from tests.export.tiny import CALIBRATION, SCANS, tiny_checkpoint
from tests.helpers.scenes import SPEC

POOLED = dataclasses.replace(SPEC, grid=dataclasses.replace(SPEC.grid, map="pooled")).with_score_threshold(0.02)


@pytest.fixture(scope="module")
def dense(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pooled") / "dense"
    export_pillar_bundle(tiny_checkpoint("channel", POOLED), folder, SCANS)
    return folder


@pytest.fixture(scope="module")
def sparse(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pooled") / "sparse"
    export_pillar_bundle(tiny_checkpoint("channel", POOLED, neck="sparse"), folder, SCANS)
    return folder


@pytest.mark.parametrize("neck", ["dense", "sparse"])
def test_runtime_and_pytorch_find_the_same(request: pytest.FixtureRequest, tmp_path: Path, neck: str) -> None:
    assert POOLED.grid.zones > 1
    folder, checkpoint = request.getfixturevalue(neck), tiny_checkpoint("channel", POOLED, neck=neck)
    bundle = load_pillar_bundle(folder)
    assert bundle.spec.grid.map == "pooled" and bundle.pillar.neck == neck
    assert isinstance(checkpoint.detector, PillarDetector)
    runtime, torch_detector = Detector(folder), ScanDetector(checkpoint.detector, POOLED)
    for points in SCANS[:3]:
        found, expected = runtime(points), torch_detector(points)
        assert len(found) == len(expected) > 0
        np.testing.assert_allclose(found.boxes, expected.boxes, atol=1e-3)
        np.testing.assert_allclose(found.scores, expected.scores, atol=1e-4)
    empty, every = np.empty((0, 4), np.float32), POOLED.with_score_threshold(0.0)
    found, expected = Detector(folder, score_threshold=0.0)(empty), ScanDetector(checkpoint.detector, every)(empty)
    assert len(found) == len(expected) and (len(found) > 0) == (neck == "dense"), "sparse: no cell is active"
    np.testing.assert_allclose(found.boxes, expected.boxes, atol=1e-3)
    np.testing.assert_allclose(found.scores, expected.scores, atol=1e-4)
    shutil.copytree(folder, tmp_path / "int8")
    quantized = quantize_bundle(tmp_path / "int8", bundle, checkpoint.detector, CALIBRATION, SCANS).quantization
    assert quantized is not None and quantized.boxes_matched > 0.9 * quantized.boxes > 5


def test_the_graphs_are_those_of_uniform_pillars(dense: Path, tmp_path: Path) -> None:
    grid = dataclasses.replace(SPEC.grid, zones=1, v_max_m=SPEC.grid.v_max_m / 2)
    uniform = dataclasses.replace(POOLED, grid=grid)
    export_pillar_bundle(tiny_checkpoint("channel", uniform), tmp_path / "uniform", SCANS)
    for graph in ("encoder.onnx", "backbone.onnx"):
        ours, theirs = (onnx.load(folder / graph).graph for folder in (dense, tmp_path / "uniform"))
        assert ours.SerializeToString(deterministic=True) == theirs.SerializeToString(deterministic=True)
