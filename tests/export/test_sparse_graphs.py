"""The sparse backbone's graph against PyTorch, in float and in 8 bits, and its bits for any number of threads."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch.utils._pytree import tree_map_only

from asca_deploy.ort_session import OrtSession
from asca_deploy.pillar.graphs import PILLAR_FEATURES
from asca_export.fast_forms import CanvasSteps
from asca_export.quantize import HEAD, STEPS, canvas_steps
from asca_export.sparse_forms import (
    BEST_CELLS,
    OTHER_CELLS,
    SparseBackbone,
    SparseSample,
    export_sparse_backbone,
    read_moments,
    round_products,
    scale_rows_to_steps,
)
from asca_pillars.config.pillar import PillarModel
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.models.pillar.neck import SparseRPNNeck
from asca_pillars.models.pillar.network import PillarDetector, build_pillar_detector
from asca_pillars.models.pillar.preparation import Placement, batch_pillars
from asca_pillars.ops.pillar.neck_rulebooks import MaskRule, NeckRulebookBuilder, NeckRulebooks, rulebook_inputs
from asca_pillars.ops.pillar.prepare import Pillars
from tests.export.tiny import NETWORK, SCANS, tiny_checkpoint
from tests.helpers.scenes import SPEC


def sparse_detector(rule: MaskRule) -> PillarDetector:
    """The weights of the tiny checkpoint in a sparse network."""
    network = dataclasses.replace(NETWORK, block_convs=(2, 1, 0), neck="sparse", active_cells=rule)
    detector = build_pillar_detector(PillarModel(spec=SPEC, network=network)).eval()
    own = detector.state_dict()
    tiny = tiny_checkpoint("channel").detector.state_dict().items()
    detector.load_state_dict(own | {name: tensor for name, tensor in tiny if name in own})
    return detector


def tables_of(pillars: Pillars, rule: MaskRule) -> NeckRulebooks[np.ndarray]:
    return NeckRulebookBuilder(SPEC.grid.ny, SPEC.grid.nx, rule).build(pillars.cells)


def sample_of(detector: PillarDetector, pillars: Pillars) -> SparseSample:
    assert isinstance(detector.neck, SparseRPNNeck)
    batch = batch_pillars([pillars], [Placement(None, tables_of(pillars, detector.neck.rule))])
    assert batch.neck is not None
    with torch.inference_mode():
        return SparseSample(detector.encode(batch.features, batch.pillar_index, batch.point_counts), batch.neck)


def quantized_backbone(detector: PillarDetector, samples: Sequence[SparseSample], steps: CanvasSteps) -> SparseBackbone:
    """Every row in steps and every weight on the grid of 8-bit arithmetic, from real values of scans with pillars."""
    backbone, counted = SparseBackbone(detector, steps), [sample.quantize_features(steps) for sample in samples]
    scale_rows_to_steps(backbone, counted)
    round_products(backbone, list(backbone.products), read_moments(backbone, counted))
    return backbone


class OpenGraph:
    def __init__(self, path: Path, threads: int) -> None:
        self.session = OrtSession(path, "cpu", "float32", threads)

    def run(self, features: np.ndarray, rulebooks: NeckRulebooks[np.ndarray]) -> HeadMaps[np.ndarray]:
        given = {PILLAR_FEATURES: features, **rulebook_inputs(rulebooks)}
        return HeadMaps(*self.session.run(HeadMaps._fields, {name: given[name] for name in self.session.inputs}))


def arrays(rulebooks: NeckRulebooks[torch.Tensor]) -> NeckRulebooks[np.ndarray]:
    return tree_map_only(torch.Tensor, lambda tensor: tensor.numpy(), rulebooks)


def assert_same_bits(runs: Sequence[HeadMaps[np.ndarray]]) -> None:
    for other in runs[1:]:
        for one, part in zip(runs[0], other, strict=True):
            np.testing.assert_array_equal(one, part)


@pytest.mark.parametrize("rule", ["sub", "fine"])
def test_the_graph_is_the_network_and_the_same_for_any_number_of_threads(rule: MaskRule, tmp_path: Path) -> None:
    detector = sparse_detector(rule)
    export_sparse_backbone(SparseBackbone(detector), tmp_path / "backbone.onnx")
    graphs = {threads: OpenGraph(tmp_path / "backbone.onnx", threads) for threads in (1, 2, 4)}
    operators = {node.op_type for node in onnx.load(tmp_path / "backbone.onnx").graph.node}
    index_operators = {"Shape", "Cast", "Add", "Transpose"}  # of places, before the head
    assert operators == {"Concat", "Gather", "Reshape", "Gemm", "Relu", "Split"} | index_operators, "nothing scatters"
    for points in SCANS[:3]:
        pillars = SPEC.pillarize(points)
        sample = sample_of(detector, pillars)
        with torch.inference_mode():
            expected = detector.head.at_cells(detector.neck(*sample))
        features, rulebooks = sample.features.numpy(), arrays(sample.rulebooks)
        for want, found in zip(expected, graphs[1].run(features, rulebooks), strict=True):
            np.testing.assert_allclose(found, want.numpy(), atol=1e-4)
        assert_same_bits([graph.run(features, rulebooks) for graph in graphs.values() for _ in range(20)])


def test_a_scan_with_a_single_pillar(tmp_path: Path) -> None:
    detector = sparse_detector("fine")
    export_sparse_backbone(SparseBackbone(detector), tmp_path / "backbone.onnx")
    graph = OpenGraph(tmp_path / "backbone.onnx", 1)
    rulebooks = NeckRulebookBuilder(SPEC.grid.ny, SPEC.grid.nx, "fine").build(np.array([37]))
    one = graph.run(np.ones((1, NETWORK.pillar_channels), np.float32), rulebooks)
    assert one.scores.shape == (len(rulebooks.head_cells), 6) and np.isfinite(one.scores).all()


def test_eight_bits_are_near_in_integers_and_the_same_for_any_number_of_threads(tmp_path: Path) -> None:
    detector = sparse_detector("fine")
    samples = [sample_of(detector, SPEC.pillarize(points)) for points in SCANS]
    steps = canvas_steps(sample.features.numpy() for sample in samples)
    backbone = SparseBackbone(detector, steps)
    counted = [sample.quantize_features(steps) for sample in samples]
    scale_rows_to_steps(backbone, counted)
    with torch.inference_mode():  # scaled, it is still the same function
        exact = SparseBackbone(detector)(*samples[0]).scores
        assert float((backbone(*counted[0]).scores - exact).square().mean().sqrt()) < 0.05 * float(exact.std())
    backbone = quantized_backbone(detector, samples, steps)
    export_sparse_backbone(backbone, tmp_path / "int8.onnx", list(backbone.products), steps=True)
    graphs = {threads: OpenGraph(tmp_path / "int8.onnx", threads) for threads in (1, 2, 4)}
    for sample in samples[:2]:
        whole = (sample.features / steps.scale + steps.empty).round().clamp(0, STEPS).numpy().astype(np.uint8)
        runs = [graph.run(whole, arrays(sample.rulebooks)) for graph in graphs.values() for _ in range(20)]
        assert_same_bits(runs)
        with torch.inference_mode():
            expected = SparseBackbone(detector)(*sample)
        for found, want in zip(runs[0], expected, strict=True):
            error = float(np.sqrt(np.square(found - want.numpy()).mean()))
            assert 0 < error < 0.1 * float(want.std()), (error, float(want.std()))
    options = onnxruntime.SessionOptions()
    options.optimized_model_filepath = str(tmp_path / "optimized.onnx")
    options.log_severity_level = 3
    onnxruntime.InferenceSession(str(tmp_path / "int8.onnx"), options, providers=["CPUExecutionProvider"])
    operators = [node.op_type for node in onnx.load(tmp_path / "optimized.onnx").graph.node]
    assert operators.count("QGemm") == len(backbone.products) and not {"Relu", "Gemm"} & set(operators)


def test_the_head_is_rounded_for_the_cells_that_boxes_come_from() -> None:
    detector = sparse_detector("fine")
    sample = sample_of(detector, SPEC.pillarize(SCANS[0]))
    backbone = SparseBackbone(detector)
    *_, (name, read, output) = backbone.passes(*sample)
    scores = output[:, : detector.head.scores.out_channels]
    assert name == HEAD and len(read) > 10 * (BEST_CELLS + OTHER_CELLS)
    best = torch.cat([read[column.argsort(descending=True)[:BEST_CELLS]] for column in scores.T])
    mean = read_moments(backbone, [sample])[HEAD].mean * (len(best) + OTHER_CELLS) - best.sum(dim=0)
    spread = (read.std(dim=0) / OTHER_CELLS**0.5).clamp_min(1e-3)
    assert float(((mean / OTHER_CELLS - read.mean(dim=0)) / spread).abs().max()) < 5, "a sample of all cells"
    assert float(((best.mean(dim=0) - read.mean(dim=0)) / spread).abs().max()) > 5, "which the best ones are not"
