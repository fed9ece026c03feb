"""What can be the first stage of two, as a checkpoint and as a bundle, and what is refused."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from asca_deploy.bundle import MANIFEST
from asca_deploy.manifest import load_pillar_bundle
from asca_deploy.shipped import shipped_bundles
from asca_export.bundle_writer import ExportOptions
from asca_export.pillar.export import export_pillar_bundle
from asca_export.two_stage.first_stage import BundleFirstStage, open_exported
from asca_pillars.base.errors import BundleError, ConfigError, ExportError
from asca_pillars.detection.proposals import ProposalSettings
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.models.two_stage.first_stage import open_first_stage, with_first_stage
from asca_pillars.ops.two_stage.first_stage import (
    FirstStageOutputs,
    FirstStageSettings,
    require_pillar_kind,
    second_stage_inputs,
)
from tests.export.tiny import NETWORK, SCANS, tiny_checkpoint
from tests.helpers.bundles import DENSE_FLOAT32
from tests.helpers.saved_checkpoint import save_checkpoint
from tests.helpers.scenes import SPEC
from tests.models.two_stage.tiny_refine import tiny_refine_model

POOLED = dataclasses.replace(SPEC, grid=dataclasses.replace(SPEC.grid, map="pooled"))


@pytest.mark.parametrize(
    ("network", "spec"), [({}, SPEC), ({"neck": "sparse"}, POOLED)], ids=["dense-warped", "sparse-pooled"]
)
def test_checkpoint_and_bundle_say_the_same(tmp_path: Path, network: dict[str, Any], spec: Any) -> None:
    checkpoint = tiny_checkpoint("channel", spec, **network)
    save_checkpoint(tmp_path / "first.ckpt", checkpoint)
    export_pillar_bundle(checkpoint, tmp_path / "bundle", SCANS)
    in_torch, in_onnx = open_first_stage(str(tmp_path / "first.ckpt")), BundleFirstStage(tmp_path / "bundle")
    assert in_torch.spec == in_onnx.spec == spec
    assert in_torch.identity == in_onnx.identity
    for points in (SCANS[0], np.empty((0, 4), np.float32)):
        expected, found = in_torch(points), in_onnx(points)
        assert found.neck.shape[-1] == 3 * NETWORK.upsample_channels
        np.testing.assert_allclose(found.neck, expected.neck, atol=1e-4)
        for one, other in zip(found.maps, expected.maps, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-3)
        if network:
            np.testing.assert_array_equal(found.cells, expected.cells)
        else:
            assert found.cells is None and expected.cells is None


def test_the_same_weights_are_taken_from_any_file_and_others_are_refused(tmp_path: Path) -> None:
    """A checkpoint, its copy, an export of it, whose own weights are rounded."""
    first, copy, other, bundle = (tmp_path / name for name in ("first.ckpt", "copy.ckpt", "other.ckpt", "bundle"))
    checkpoint = tiny_checkpoint("channel")
    save_checkpoint(first, checkpoint)
    save_checkpoint(copy, checkpoint._replace(config=dataclasses.replace(checkpoint.config, name="copy")))
    export_pillar_bundle(checkpoint, bundle, SCANS, ExportOptions(weights=first))
    exported = load_pillar_bundle(bundle)
    model = with_first_stage(tiny_refine_model(first))
    assert model.first_stage_identity == exported.provenance.weights_sha256
    for source in (copy, bundle):
        moved = dataclasses.replace(model, first_stage=str(source))
        assert with_first_stage(moved) == moved
    assert isinstance(checkpoint.detector, PillarDetector)
    with torch.no_grad():
        checkpoint.detector.head.scores.weight[0] += 1e-6
    save_checkpoint(other, checkpoint)
    with pytest.raises(ConfigError, match=r"other\.ckpt: other weights are there"):
        with_first_stage(dataclasses.replace(model, first_stage=str(other)))
    manifest = json.loads((bundle / MANIFEST).read_text())
    del manifest["provenance"]["weights_sha256"]
    (bundle / MANIFEST).write_text(json.dumps(manifest))
    assert BundleFirstStage(bundle).identity == " ".join(graph.sha256 for graph in exported.graphs.values())


def test_rows_of_active_cells_are_a_map_with_zeros_beside_them(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "first.ckpt", tiny_checkpoint("channel", neck="sparse"))
    stage = open_first_stage(str(tmp_path / "first.ckpt"))
    points = SCANS[0][(np.abs(SCANS[0][:, :2] - [8, 0]) < 4).all(axis=1)]
    rows = stage(points)
    assert rows.cells is not None
    height, width, _, _ = SPEC.anchors.shape
    neck = np.zeros((height * width, rows.neck.shape[1]), np.float32)
    neck[rows.cells] = rows.neck
    maps = [np.full((part.shape[1], height * width), -9, np.float32) for part in rows.maps]
    for whole, part in zip(maps, rows.maps, strict=True):
        whole[:, rows.cells] = part.T
    whole_maps = type(rows.maps)(*(part.reshape(-1, height, width) for part in maps))
    settings = FirstStageSettings(ProposalSettings(score_threshold=0.0))
    expected = second_stage_inputs(
        FirstStageOutputs(whole_maps, neck.reshape(height, width, -1)), points, SPEC, settings
    )
    found = second_stage_inputs(rows, points, SPEC, settings)
    assert len(found.proposals) and len(found.keypoints) and 0 < len(rows.cells) < height * width
    np.testing.assert_array_equal(found.proposals.boxes, expected.proposals.boxes)
    np.testing.assert_array_equal(found.bev, expected.bev)


def test_a_second_stage_is_not_trained_on_eight_bits() -> None:
    with pytest.raises(ConfigError, match="fast: a bundle in int8; give one in float32"):
        open_first_stage("fast")
    with pytest.raises(ExportError, match="fast: a bundle in int8; give one in float32"):
        open_exported("fast")


def test_the_first_stage_of_the_bundle_that_ships_is_known_by_its_unrounded_weights() -> None:
    folder = shipped_bundles()["default_float32"]
    stage = open_first_stage("default_float32")
    bundle = load_pillar_bundle(folder)
    assert stage.identity == bundle.provenance.weights_sha256 and stage.spec == bundle.spec
    maps, exported = (each(SCANS[0]).maps for each in (stage, BundleFirstStage(folder)))
    np.testing.assert_allclose(maps.scores, exported.scores, atol=0.1)  # weights in 16 bits


def test_bundles_whose_weights_cannot_be_taken(tmp_path: Path) -> None:
    checkpoint = tiny_checkpoint("channel")
    save_checkpoint(tmp_path / "first.ckpt", checkpoint)
    with pytest.raises(BundleError, match=r"no such bundle or checkpoint; set model\.first_stage"):
        open_first_stage("asca_smal")
    with pytest.raises(BundleError, match=r"dense_float32: holds no weights\.ckpt, .* --with-weights"):
        open_first_stage(str(DENSE_FLOAT32))
    export_pillar_bundle(checkpoint, tmp_path / "bundle", SCANS, ExportOptions(weights=tmp_path / "first.ckpt"))
    shutil.copyfile(tmp_path / "first.ckpt", tmp_path / "bundle" / "weights.ckpt")
    with pytest.raises(BundleError, match=r"weights\.ckpt: is damaged, or of another bundle"):
        open_first_stage(str(tmp_path / "bundle"))
    (tmp_path / "bundle" / MANIFEST).write_text('{"kind": "pillar"}')
    with pytest.raises(BundleError, match=r"bundle\.json: cannot be read, or is damaged"):
        open_first_stage(str(tmp_path / "bundle"))


def test_two_stages_are_no_first_stage() -> None:
    with pytest.raises(ConfigError, match=r"a_bundle: model.kind pillar_refine; give a detector of kind pillar"):
        require_pillar_kind("a_bundle", "pillar_refine")
