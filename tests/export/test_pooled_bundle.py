"""A pooled map in 8 bits, with both necks, and its graphs, which say nothing of it."""

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path

import onnx
import pytest

from asca_deploy.manifest import load_pillar_bundle
from asca_export import int8
from asca_export.fast_forms import FastBackbone
from asca_export.graphs import export_backbone
from asca_pillars.models.pillar.network import PillarDetector
from tests.export.sweeps import all_at_once
from tests.export.tiny import CALIBRATION, CHECKPOINTS, POOLED, SCANS, tiny_detector


@pytest.mark.parametrize("name", ["pooled", "pooled_sparse"])
def test_eight_bits_find_the_same(
    exported: Callable[[str], Path], tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, detector = shutil.copytree(exported(name), tmp_path / "int8"), CHECKPOINTS[name]().detector
    assert isinstance(detector, PillarDetector) and POOLED.grid.zones > 1
    monkeypatch.setattr(int8, "sweep", all_at_once)
    bundle = int8.quantize_bundle(folder, load_pillar_bundle(folder), detector, CALIBRATION, SCANS[:4])
    report = bundle.quantization
    assert report is not None and report.boxes_matched > 0.9 * report.boxes > 5
    assert 0 < report.logit_rms_error <= int8.MAX_LOGIT_ERROR


def test_the_graphs_are_those_of_uniform_pillars(tmp_path: Path) -> None:
    grid = dataclasses.replace(POOLED.grid, map="warped", zones=1, v_max_m=POOLED.grid.v_max_m / 2)
    graphs = []
    for spec in (POOLED, dataclasses.replace(POOLED, grid=grid)):
        detector = tiny_detector("channel", spec)
        path = tmp_path / f"{spec.grid.map}.onnx"
        export_backbone(FastBackbone(detector), detector.grid.map_shape, path)
        graphs.append(onnx.load(path).graph.SerializeToString(deterministic=True))
    assert graphs[0] == graphs[1]
