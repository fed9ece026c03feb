"""The sample scan through a sparse network's graphs, stage by stage as on the vehicle, against PyTorch."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from asca_deploy import sample_scan_path
from asca_deploy.graph import Tensor
from asca_deploy.ort_session import OrtSession
from asca_deploy.sparse_backbone import SparseBackboneGraph
from asca_export.exporter import MIN_SCANS, export_bundle
from asca_export.graphs import export_encoder
from asca_export.sparse_forms import SparseBackbone
from asca_export.sparse_graphs import export_sparse_backbone
from asca_pillars.config import Config
from asca_pillars.data.scans.scan_reader import read_scan
from asca_pillars.errors import BundleError, ExportError
from asca_pillars.models.checkpoint import Checkpoint
from asca_pillars.models.pillar.pillar_detector import build_detector
from asca_pillars.models.scan_detector import ScanDetector
from asca_pillars.tables.neck_tables import NeckTableBuilder
from tests.export.tiny import NETWORK, tiny_checkpoint
from tests.scenes import SPEC

CONFIG = Config(detector=SPEC, network=dataclasses.replace(NETWORK, neck="sparse"))


@pytest.fixture(scope="module")
def checkpoint() -> Checkpoint:
    detector = build_detector(CONFIG).eval()
    detector.load_state_dict(tiny_checkpoint(CONFIG.network.cpa).detector.state_dict())
    return Checkpoint(CONFIG, detector, 0)


def test_the_vehicle_finds_what_pytorch_finds(checkpoint: Checkpoint, tmp_path: Path) -> None:
    detector, points = checkpoint.detector, read_scan(sample_scan_path()).points
    export_encoder(detector, tmp_path / "encoder.onnx")
    export_sparse_backbone(SparseBackbone(detector), tmp_path / "backbone.onnx")
    encoder = OrtSession(tmp_path / "encoder.onnx", "cpu", "float32", 1)
    session = OrtSession(tmp_path / "backbone.onnx", "cpu", "float32", 2)
    channels, anchors = NETWORK.pillar_channels, SPEC.anchors.shape[2]
    backbone = SparseBackboneGraph(tmp_path / "backbone.onnx", session, channels, "float32", anchors)
    stage = NeckTableBuilder(SPEC.grid.ny, SPEC.grid.nx, CONFIG.network.active_cells)

    spec = SPEC.with_score_threshold(0.05)  # nobody trained these weights
    pillars = spec.pillarize(points)
    inputs = {name: getattr(pillars, name) for name in ("features", "pillar_index", "point_counts")}
    (features,) = encoder.run(inputs, ["pillar_features"])
    tables = stage.build(pillars.cells)
    found = spec.decode(backbone.run(features, tables), tables.head_cells)

    expected = ScanDetector(detector, spec)(points)
    assert len(found) == len(expected) > 2
    np.testing.assert_allclose(found.boxes, expected.boxes, atol=1e-3)
    np.testing.assert_allclose(found.scores, expected.scores, atol=1e-4)
    np.testing.assert_array_equal(found.labels, expected.labels)


def test_a_graph_of_other_sizes_is_refused(checkpoint: Checkpoint, tmp_path: Path) -> None:
    path = tmp_path / "backbone.onnx"
    export_sparse_backbone(SparseBackbone(checkpoint.detector), path)
    session = OrtSession(path, "cpu", "float32", 1)
    assert session.inputs["same_1"] == Tensor("int32", (None, 9))
    with pytest.raises(BundleError, match="pillar_features"):
        SparseBackboneGraph(path, session, NETWORK.pillar_channels + 1, "float32", SPEC.anchors.shape[2])


def test_a_bundle_of_a_sparse_neck_is_refused(checkpoint: Checkpoint, tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="sparse has no bundle yet"):
        export_bundle(checkpoint, tmp_path / "bundle", [read_scan(sample_scan_path()).points] * MIN_SCANS)
