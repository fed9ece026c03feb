"""A pooled map from the checkpoint to boxes, with both necks: PyTorch and the runtime pool alike."""

import dataclasses
from pathlib import Path

import numpy as np
import onnx
import pytest

from asca_deploy import Detector, load_bundle
from asca_export.exporter import export_bundle
from asca_pillars.models.scan_detector import ScanDetector
from tests.export.tiny import SCANS, tiny_checkpoint
from tests.scenes import SPEC, make_scene

CALIBRATION = [make_scene(seed)[0] for seed in range(100, 108)]
POOLED = dataclasses.replace(SPEC, grid=dataclasses.replace(SPEC.grid, map="pooled")).with_score_threshold(0.02)


@pytest.mark.parametrize("neck", ["dense", "sparse"])
def test_runtime_and_pytorch_find_the_same(tmp_path: Path, neck: str) -> None:
    assert POOLED.grid.zones > 1
    checkpoint = tiny_checkpoint("channel", POOLED, neck=neck)
    bundle = export_bundle(checkpoint, tmp_path / "float", SCANS)
    assert load_bundle(tmp_path / "float") == bundle and bundle.spec.grid.map == "pooled"
    runtime, torch_detector = Detector(tmp_path / "float"), ScanDetector(checkpoint.detector, POOLED)
    for points in SCANS[:3]:
        found, expected = runtime(points), torch_detector(points)
        assert len(found) == len(expected) > 0
        np.testing.assert_allclose(found.boxes, expected.boxes, atol=1e-3)
        np.testing.assert_allclose(found.scores, expected.scores, atol=1e-4)
    assert len(runtime(np.empty((0, 4), np.float32))) >= 0
    quantized = export_bundle(checkpoint, tmp_path / "int8", SCANS, calibration=CALIBRATION).quantization
    assert quantized is not None and quantized.boxes_matched > 0.9 * quantized.boxes > 5


def test_the_graphs_are_those_of_uniform_pillars(tmp_path: Path) -> None:
    grid = dataclasses.replace(SPEC.grid, zones=1, v_max_m=SPEC.grid.v_max_m / 2)
    uniform = dataclasses.replace(POOLED, grid=grid)
    for name, spec in (("pooled", POOLED), ("uniform", uniform)):
        export_bundle(tiny_checkpoint("channel", spec), tmp_path / name, SCANS)
    for graph in ("encoder.onnx", "backbone.onnx"):
        ours, theirs = (onnx.load(tmp_path / name / graph).graph for name in ("pooled", "uniform"))
        assert ours.SerializeToString(deterministic=True) == theirs.SerializeToString(deterministic=True)
