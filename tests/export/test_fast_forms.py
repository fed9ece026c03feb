"""Each fast form is the same function as what it replaces.

A sparse neck as dense convolutions: the same function, and a bundle that runs where a sparse neck cannot.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_deploy import Detector
from asca_deploy.manifest import load_pillar_bundle
from asca_export import graphs
from asca_export.bundle_writer import ExportOptions
from asca_export.export import export_bundle
from asca_export.fast_forms import (
    NEVER,
    STEP_VALUE,
    CanvasSteps,
    FastBackbone,
    MarkedEncoder,
    MaskedBackbone,
    Upsample,
    split_encoder,
)
from asca_export.pillar.export import export_pillar_bundle
from asca_export.two_stage.first_stage import BundleFirstStage
from asca_pillars.base.errors import ExportError
from asca_pillars.config.pillar import CpaReading
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.models.pillar.neck import SparseRPNNeck
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.models.pillar.preparation import batch_pillars
from asca_pillars.ops.pillar.neck_rulebooks import NeckRulebooks
from tests.deploy.conftest import needs_openvino
from tests.export.deployed import assert_same_boxes
from tests.export.tiny import CALIBRATION, NOTHING, ONE_POINT, SCANS, sparse_checkpoint, tiny_checkpoint, tiny_detector
from tests.helpers.scenes import SPEC


def padded(image: torch.Tensor) -> torch.Tensor:
    """(1, C, ny, nx) -> the canvas (1, ny + 1, nx + 1, C) with zeros in its first row and column."""
    return functional.pad(image, (1, 0, 1, 0)).permute(0, 2, 3, 1)


@pytest.mark.parametrize("cpa", ["none", "channel", "paper", "linear"])
@torch.no_grad()
def test_the_maximum_before_bias_and_relu(cpa: CpaReading, tmp_path: Path) -> None:
    encode = tiny_detector(cpa).encode
    split = split_encoder(encode)
    assert split is not None
    counts = torch.tensor([1, 4, 2, 32, 1])
    points = torch.randn(40, 9) * 3
    given = (points, torch.arange(5).repeat_interleave(counts), counts)
    maxima, *_ = split.pfn(*given)
    torch.testing.assert_close(split.attention(maxima), encode(*given), atol=1e-5, rtol=1e-5)
    graphs.export_pfn(split.pfn, tmp_path / "pfn.onnx")
    operators = [node.op_type for node in onnx.load(tmp_path / "pfn.onnx").graph.node]
    assert operators.index("MatMul") < operators.index("ScatterND") < operators.index("Relu")


@pytest.mark.parametrize("counts", [[1], [5], [1, 1], [1, 9], [9, 1], [1, 4, 2, 32, 1], [1] * 50, [64, 64, 64]])
@torch.no_grad()
def test_pieces_of_few_points_give_the_same_maximum(counts: list[int], pfn_graph: Path) -> None:
    """Some of the PIECES that the graph reduces one after the other are empty then."""
    split = split_encoder(tiny_detector("channel").encode)
    assert split is not None
    sizes = torch.tensor(counts)
    given = {
        "features": torch.randn(sum(counts), 9, generator=torch.Generator().manual_seed(0)) * 3,
        "pillar_index": torch.arange(len(counts)).repeat_interleave(sizes),
        "point_counts": sizes,
    }
    session = onnxruntime.InferenceSession(pfn_graph)
    actual = session.run(None, {name: value.numpy() for name, value in given.items()})
    for computed, expected in zip(actual, split.pfn(*given.values()), strict=True):
        torch.testing.assert_close(torch.from_numpy(computed), expected, atol=1e-5, rtol=1e-5)


@pytest.fixture(scope="module")
def pfn_graph(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pieces") / "pfn.onnx"
    split = split_encoder(tiny_detector("channel").encode)
    assert split is not None
    graphs.export_pfn(split.pfn, path)
    return path


def test_an_encoder_that_needs_every_point_stays_as_it_is() -> None:
    for encode in (tiny_detector("point").encode, tiny_detector("none", empty_slots=True).encode):
        assert split_encoder(encode) is None


@torch.no_grad()
def test_neck_and_head() -> None:
    detector = tiny_detector("none")
    image = torch.rand(1, 16, detector.grid.ny, detector.grid.nx) - 0.3
    expected = detector.head(detector.neck(image))
    for ours, theirs in zip(FastBackbone(detector)(padded(image)), expected, strict=True):
        torch.testing.assert_close(ours.permute(0, 3, 1, 2), theirs, atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_a_canvas_in_steps_of_its_own_with_padding_that_stands_for_zero() -> None:
    detector = tiny_detector("none")
    steps = CanvasSteps(torch.rand(16) / 10 + 0.01, torch.randint(0, 256, (16,)).float())
    counted = torch.randint(0, 256, (1, 16, detector.grid.ny, detector.grid.nx)).float()
    image = steps.scale[:, None, None] * (counted - steps.empty[:, None, None])
    canvas = padded(counted)
    canvas[:, 0], canvas[:, :, 0] = steps.empty, steps.empty
    expected = detector.head(detector.neck(image))
    for ours, theirs in zip(FastBackbone(detector, steps)(canvas * STEP_VALUE), expected, strict=True):
        torch.testing.assert_close(ours.permute(0, 3, 1, 2), theirs, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("stride", [1, 2, 4])
@torch.no_grad()
def test_depth_to_space_is_the_transposed_convolution(stride: int) -> None:
    deblock = nn.Sequential(nn.ConvTranspose2d(5, 3, stride, stride, bias=False), nn.BatchNorm2d(3), nn.ReLU()).eval()
    features = torch.randn(1, 5, 6, 7)
    torch.testing.assert_close(Upsample(deblock)(features).permute(0, 3, 1, 2), deblock(features))


def test_the_detector_stays_as_it_was() -> None:
    detector = tiny_detector("none")
    before = {name: value.clone() for name, value in detector.state_dict().items()}
    split_encoder(detector.encode)
    FastBackbone(detector, CanvasSteps(torch.full((16,), 0.1), torch.full((16,), 9.0)))
    assert all(torch.equal(before[name], value) for name, value in detector.state_dict().items())
    assert detector.neck.get_submodule("blocks.0.0").padding == (1, 1)


def test_multiply_accumulates_are_those_of_the_shapes(tmp_path: Path) -> None:
    detector = tiny_detector("none")
    graphs.export_backbone(FastBackbone(detector), detector.grid.map_shape, tmp_path / "backbone.onnx")
    cells = detector.grid.ny * detector.grid.nx
    blocks = [  # (cells of the output, inputs, outputs, convolutions): one strided and one plain convolution each
        cells // 4 * 9 * (16 * 16 + 16 * 16),
        cells // 16 * 9 * (16 * 24 + 24 * 24),
        cells // 64 * 9 * (24 * 32 + 32 * 32),
    ]
    upsamples = [cells // 4 * 16 * 16, cells // 16 * 24 * 16 * 4, cells // 64 * 32 * 16 * 16]
    head = cells // 4 * 48 * (6 + 42 + 12)
    assert graphs.multiply_accumulates(tmp_path / "backbone.onnx") == sum(blocks) + sum(upsamples) + head


LEFT = [points[points[:, 1] > 4] for points in SCANS]
"""Whole ones make every cell of the small map active."""


@pytest.fixture(scope="module")
def bundles(exported: Callable[[str], Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same weights with tables and with masks, of the rule that has one more mask."""
    dense = tmp_path_factory.mktemp("bundles") / "dense"
    export_pillar_bundle(sparse_checkpoint("fine"), dense, SCANS, ExportOptions(dense_neck=True))
    return exported("fine"), dense


class _Given(nn.Module):
    """An encoder that gives these features whatever it is asked."""

    def __init__(self, features: Tensor) -> None:
        super().__init__()
        self.features = features

    def forward(self, *_: Tensor) -> Tensor:
        return self.features


def _canvas(detector: PillarDetector, features: Tensor, cells: Tensor) -> Tensor:
    """(1, ny + 1, nx + 1, C)"""
    image = detector.scatter(features, cells, [len(cells)]).permute(0, 2, 3, 1)
    return F.pad(image, (0, 0, 1, 0, 1, 0))


def _rows(maps: tuple[Tensor, ...], rulebooks: NeckRulebooks[Tensor]) -> HeadMaps[Tensor]:
    return HeadMaps(*(part.flatten(0, 2)[rulebooks.head_cells.long()] for part in maps))


@pytest.mark.parametrize("rule", ["sub", "fine"])
def test_masks_give_what_tables_give(rule: str) -> None:
    """Also where a pillar's features are all zero, which the first layer's bias makes something of."""
    detector = tiny_detector("channel", neck="sparse", active_cells=rule)
    pillars = SPEC.pillarize(LEFT[0])
    batch = batch_pillars([pillars], [detector.preparation.place(pillars)])
    rulebooks = batch.neck
    assert rulebooks is not None and isinstance(detector.neck, SparseRPNNeck)
    with torch.inference_mode():
        features = detector.encode(batch.features, batch.pillar_index, batch.point_counts).clone()
        features[:: len(features) // 5] = 0
        expected = detector.head.at_cells(detector.neck(features, rulebooks))
        backbone, marked = MaskedBackbone(detector), MarkedEncoder(_Given(features))(*batch[:3])
        found = backbone(_canvas(detector, marked, batch.cells))
        unmarked = backbone(_canvas(detector, features, batch.cells))
    for ours, theirs in zip(_rows(found, rulebooks), expected, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)
    elsewhere = torch.ones(found[0].shape[1:3]).bool().flatten()
    elsewhere[rulebooks.head_cells.long()] = False
    assert elsewhere.any() and (found[0].flatten(0, 2)[elsewhere] == NEVER).all()
    assert (_rows(unmarked, rulebooks).scores - expected.scores).abs().max() > 0.01, "the marks decide"


def test_the_bundles_find_the_same(bundles: tuple[Path, Path]) -> None:
    sparse, dense = (Detector(folder, score_threshold=0.02) for folder in bundles)
    manifest = load_pillar_bundle(bundles[1])
    assert (manifest.pillar.neck, manifest.pillar.active_cells) == ("dense", None)
    assert manifest.parity is not None and manifest.parity.scans == len(SCANS)
    assert manifest.provenance.weights_sha256 == load_pillar_bundle(bundles[0]).provenance.weights_sha256
    assert sum(len(sparse(points)) for points in SCANS) > 20
    for points in (*SCANS, *LEFT, ONE_POINT, NOTHING):
        assert_same_boxes(dense(points), sparse(points))
    assert len(Detector(bundles[1], score_threshold=1e-6)(NOTHING)) == 0, "no cell is active"


def test_a_second_stage_reads_the_same_map_of_both(bundles: tuple[Path, Path]) -> None:
    """The masks are joined after the map, and are not it."""
    rows, whole = (BundleFirstStage(folder)(LEFT[0]).neck for folder in bundles)
    channels = rows.shape[-1]
    assert whole.shape[-1] == channels
    active = whole.reshape(-1, channels)
    active = active[active.any(axis=1)]
    np.testing.assert_allclose(np.sort(active, axis=0), np.sort(rows[rows.any(axis=1)], axis=0), atol=1e-4)


@needs_openvino
def test_openvino_runs_it(bundles: tuple[Path, Path]) -> None:
    ours, theirs = Detector(bundles[1], provider="openvino")(SCANS[0]), Detector(bundles[0])(SCANS[0])
    assert len(ours) == len(theirs) > 0
    np.testing.assert_allclose(ours.boxes, theirs.boxes, atol=1e-3)


def test_a_graph_with_scores_elsewhere_is_no_proof(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("asca_export.parity.NEVER", -9.0)
    with pytest.raises(ExportError, match="head `scores` of inactive cells"):
        export_pillar_bundle(sparse_checkpoint("sub"), tmp_path / "bundle", LEFT, ExportOptions(dense_neck=True))
    assert not (tmp_path / "bundle").exists()


def test_what_has_no_such_form_is_refused_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="--dense-neck: the neck of this model is dense"):
        export_bundle(tiny_checkpoint("channel"), tmp_path / "bundle", SCANS, ExportOptions(dense_neck=True))
    with pytest.raises(ExportError, match="--dense-neck with --int8"):
        export_bundle(
            sparse_checkpoint("sub"),
            tmp_path / "bundle",
            SCANS,
            ExportOptions(dense_neck=True, calibration=CALIBRATION),
        )
