"""From a checkpoint to a proven bundle: parity for every reading, and refusal when the graphs are not the model."""

import json
import math
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from numpy.typing import NDArray

from asca_deploy import Detector
from asca_deploy.golden import golden_stages
from asca_deploy.manifest import load_pillar_bundle
from asca_deploy.pillar.encoder import PILLAR_MAXIMA, pfn_inputs
from asca_deploy.pillar.pipeline import PillarPipeline
from asca_export import graphs
from asca_export.fast_forms import FastBackbone, PfnLayer
from asca_export.parity import BOX_TOLERANCE_M, MAP_TOLERANCE, YAW_TOLERANCE_RAD, compare_boxes
from asca_export.pillar.export import export_pillar_bundle
from asca_pillars.base.errors import ExportError
from asca_pillars.config.pillar import PillarModel
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.detection.decode import VOTE_SCORE, HeadMaps
from asca_pillars.models.build import ScanDetector
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.scans.input_check import ExpectedInput, measure_expected_input
from asca_pillars.scans.scan_reader import read_scan
from tests.export.deployed import assert_same_boxes
from tests.export.tiny import CHECKPOINTS, NOTHING, ONE_POINT, READINGS, SCANS, tiny_checkpoint, tiny_detector
from tests.helpers.scenes import SPEC

Exports = Callable[[str], Path]


@pytest.mark.parametrize("name", CHECKPOINTS)
def test_a_bundle_says_what_it_is_and_finds_what_its_checkpoint_finds(exported: Exports, name: str) -> None:
    checkpoint, bundle = CHECKPOINTS[name](), load_pillar_bundle(exported(name))
    detector, model = checkpoint.detector, checkpoint.config.model
    assert isinstance(detector, PillarDetector) and isinstance(model, PillarModel)
    assert bundle.spec == model.spec and bundle.provenance.steps == 0 and bundle.backbone_gmac > 0
    assert (bundle.pillar.cpa, bundle.pillar.neck) == (model.network.cpa, model.network.neck)
    assert bundle.pillar.active_cells == (model.network.active_cells if model.network.neck == "sparse" else None)
    parity = bundle.parity
    assert parity is not None and parity.scans == len(SCANS)
    assert 0 < parity.head_maps_max_abs_error <= MAP_TOLERANCE
    assert parity.box_max_error_m <= BOX_TOLERANCE_M and parity.yaw_max_error_rad <= YAW_TOLERANCE_RAD
    every = Detector(exported(name), score_threshold=0.0, threads=1)
    every_in_torch = ScanDetector(detector, model.spec.with_score_threshold(0.0))
    if name in READINGS:  # one scan is compared, because PyTorch takes seconds of attention among points
        found = every(SCANS[0])
        assert len(found) > 0
        assert_same_boxes(found, every_in_torch(SCANS[0]), box=1e-2, score=1e-3)
        return
    runtime, in_torch = Detector(exported(name)), ScanDetector(detector, model.spec)
    for points in SCANS[:3]:
        assert len(runtime(points)) > 0
        assert_same_boxes(runtime(points), in_torch(points))
    for points in (ONE_POINT, NOTHING):
        assert_same_boxes(every(points), every_in_torch(points))
    assert len(every(ONE_POINT)) > 0
    assert (len(every(NOTHING)) > 0) == (model.network.neck == "dense"), "sparse: no cell is active"


def test_features_are_compared_at_their_own_scale(tmp_path: Path) -> None:
    """Features of 1e5 differ by more than 1e-3 from rounding alone, and the network that follows divides it away."""
    checkpoint = tiny_checkpoint("none")
    assert isinstance(checkpoint.detector, PillarDetector)
    encode, first = checkpoint.detector.encode, checkpoint.detector.neck.get_submodule("blocks.0.0")
    assert isinstance(first, torch.nn.Conv2d)
    with torch.no_grad():
        encode.norm.weight.mul_(1e5)
        encode.norm.bias.mul_(1e5)
        first.weight.div_(1e5)
    parity = export_pillar_bundle(checkpoint, tmp_path, SCANS).parity
    assert parity is not None and parity.head_maps_max_abs_error <= MAP_TOLERANCE


def test_graphs_carry_the_contract(exported: Exports) -> None:
    folder = exported("channel")
    for name in ("pfn.onnx", "encoder.onnx", "backbone.onnx"):
        model = onnx.load(folder / name)
        properties = {item.key: json.loads(item.value) for item in model.metadata_props}
        assert properties["spec"]["grid"]["zones"] == SPEC.grid.zones
        assert [spec["name"] for spec in properties["spec"]["classes"]] == list(SPEC.class_names)
        assert b"site-packages" not in (folder / name).read_bytes()  # nor any other folder of this machine
    for path in (folder / "pfn.onnx", exported("point") / "encoder.onnx"):
        takes_points = onnx.load(path).graph
        assert [node.name for node in takes_points.input] == ["features", "pillar_index", "point_counts"]
        assert takes_points.input[0].type.tensor_type.shape.dim[0].dim_param  # the number of points is dynamic
    assert [node.name for node in onnx.load(folder / "encoder.onnx").graph.input] == ["pillar_maxima"]
    backbone = onnx.load(folder / "backbone.onnx").graph
    assert [node.name for node in backbone.output] == ["scores", "boxes", "directions"]


def test_pfn_graph_gives_the_same_maxima_every_time(exported: Exports) -> None:
    """onnxruntime's threads race for the repeated indices of ScatterND: the runtime has to keep them out."""
    pipeline = Detector(exported("none"), threads=2).pipeline
    rng = np.random.default_rng(0)
    points = rng.uniform((5, -6, -2, 0), (25, 7, 0, 1), (12000, 4)).astype(np.float32)
    assert isinstance(pipeline, PillarPipeline)
    pfn = pipeline.encode.pfn
    assert pfn is not None
    pillars = pipeline.pillarize(points)
    assert pillars.point_counts.max() > 4  # indices repeat

    def maxima() -> NDArray[np.float32]:
        return pfn.run((PILLAR_MAXIMA,), pfn_inputs(pfn, pillars))[0]

    first = maxima()
    assert all(np.array_equal(maxima(), first) for _ in range(300))
    np.testing.assert_allclose(pipeline.encode.maxima(pillars), first, rtol=1e-5, atol=1e-5)


def test_golden_vectors_have_the_maxima_that_the_pfn_graph_gives(exported: Exports) -> None:
    pipeline = Detector(exported("channel"), threads=1).pipeline
    assert isinstance(pipeline, PillarPipeline)
    stages = golden_stages(pipeline, SCANS[0])
    assert list(stages)[1:4] == ["pillarize", "pfn", "encode"]
    pfn = onnxruntime.InferenceSession(exported("channel") / "pfn.onnx", providers=["CPUExecutionProvider"])
    given = {name: stages["pillarize"][name] for name in ("features", "pillar_index", "point_counts")}
    (maxima,) = pfn.run([PILLAR_MAXIMA], given)
    np.testing.assert_allclose(stages["pfn"][PILLAR_MAXIMA], maxima, rtol=1e-5, atol=1e-5)


def test_a_pfn_graph_that_other_runtimes_would_run_differently_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This runtime takes the parameters from the graph, and computes the layer itself."""
    export_pfn = graphs.export_pfn

    def export_doubled(layer: PfnLayer, path: Path) -> None:
        export_pfn(layer, path)
        model = onnx.load(path)
        (last,) = (node for node in model.graph.node if PILLAR_MAXIMA in node.output)
        last.output[0] = "maxima"
        model.graph.node.append(onnx.helper.make_node("Add", ["maxima", "maxima"], [PILLAR_MAXIMA]))
        onnx.save(model, path)

    monkeypatch.setattr(graphs, "export_pfn", export_doubled)
    with pytest.raises(ExportError, match=r"scan 0: PyTorch and onnxruntime differ at stage pfn"):
        export_pillar_bundle(tiny_checkpoint("none"), tmp_path / "bundle", SCANS)


def test_graphs_that_are_not_the_model_are_refused_and_the_old_bundle_stays(
    exported: Exports, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(exported("channel"), tmp_path / "bundle")
    before = {path.name: path.read_bytes() for path in (tmp_path / "bundle").iterdir()}
    other = tiny_detector("channel")
    with torch.no_grad():
        other.head.get_parameter("boxes.bias").add_(0.01)
    export_backbone = graphs.export_backbone
    wrong = FastBackbone(other)
    monkeypatch.setattr(graphs, "export_backbone", lambda _, shape, path: export_backbone(wrong, shape, path))
    with pytest.raises(ExportError, match=r"scan 0: PyTorch and onnxruntime differ at stage head `boxes`: .* 0\.01"):
        export_pillar_bundle(tiny_checkpoint("channel"), tmp_path / "bundle", SCANS)
    assert {path.name: path.read_bytes() for path in (tmp_path / "bundle").iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["bundle"], "temporary files are left"


def test_the_expected_input_is_the_checkpoints_own(exported: Exports, tmp_path: Path) -> None:
    checkpoint, measured = tiny_checkpoint("none"), load_pillar_bundle(exported("none"))
    assert measured.expected_input == measure_expected_input(SCANS, checkpoint.config.data.camera_view)
    assert measured.expected_input_from == "export"
    known = ExpectedInput((1, 2), (0.1, 0.2), None, camera_view=False)
    copied = export_pillar_bundle(checkpoint._replace(expected_input=known), tmp_path / "copied", SCANS)
    assert load_pillar_bundle(tmp_path / "copied") == copied
    assert (copied.expected_input, copied.expected_input_from) == (known, "training")


def test_too_few_scans_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="7 scans given"):
        export_pillar_bundle(tiny_checkpoint("none"), tmp_path / "bundle", SCANS[:7])


@pytest.mark.parametrize("neck", ["dense", "sparse"])
def test_parity_is_not_proven_on_nothing(neck: str, tmp_path: Path) -> None:
    behind = [points * np.array([-1, 1, 1, 1], np.float32) for points in SCANS]
    with pytest.raises(ExportError, match="none of the scans given to prove parity on has a point"):
        export_pillar_bundle(tiny_checkpoint("none", neck=neck), tmp_path / "bundle", behind)
    assert not list(tmp_path.iterdir())
    bundle = export_pillar_bundle(tiny_checkpoint("none", neck=neck), tmp_path / "bundle", [*SCANS[:7], behind[0]])
    assert bundle.parity is not None and bundle.parity.scans == 7


FEW = replace(SPEC, post=replace(SPEC.post, candidates=100))
"""With fewer of the many boxes of one score, which are compared with each other."""


def _maps(seed: int) -> HeadMaps:
    rng = np.random.default_rng(seed)
    height, width, count, _ = SPEC.anchors.shape
    kinds = ((1, -4, 1), (7, 0, 0.1), (2, 0, 1))
    return HeadMaps(*(rng.normal(mean, std, (n * count, height, width)).astype(np.float32) for n, mean, std in kinds))


def test_boxes_that_differ_are_noticed() -> None:
    maps = _maps(0)
    assert compare_boxes(maps, maps, SPEC).center_size_m == 0
    moved = maps._replace(boxes=maps.boxes + np.float32(0.02))
    turned = maps._replace(directions=-maps.directions)
    fewer = maps._replace(scores=np.where(maps.scores == maps.scores.max(), -20, maps.scores))
    for other in (moved, turned, fewer):
        with pytest.raises(ExportError, match="has no partner"):
            compare_boxes(maps, other, SPEC)


def test_ties_are_no_differences() -> None:
    """Two overlapping anchors of equal score: which one survives is arbitrary."""
    maps = _maps(0)
    maps.scores[:] = -20
    left, right = maps.scores.copy(), maps.scores.copy()
    left[0, 10, 10], left[0, 10, 11] = 2.0, 2.0 - 1e-6
    right[0, 10, 10], right[0, 10, 11] = 2.0 - 1e-6, 2.0
    compare_boxes(maps._replace(scores=left), maps._replace(scores=right), FEW)


def test_a_vote_that_hangs_on_a_rounding_is_no_difference() -> None:
    """The second box reaches VOTE_SCORE on one side alone, and moves the first one there."""
    maps, spec = _maps(0), replace(FEW, post=replace(FEW.post, vote_iou=0.3))
    maps.scores[:], maps.boxes[:] = -20, 0
    logit = math.log(VOTE_SCORE / (1 - VOTE_SCORE))
    sides = []
    for rounding in (-1e-6, 1e-6):
        scores = maps.scores.copy()
        scores[0, 10, 10], scores[0, 10, 11] = -0.5, logit + rounding
        sides.append(maps._replace(scores=scores))
    (alone,), (voted,) = (spec.decode(side).boxes for side in sides)
    assert np.abs(alone - voted).max() > 0.01
    below, above = sides
    compare_boxes(below, above, spec)


def test_an_overlap_as_large_as_suppression_allows_is_a_tie() -> None:
    maps = _maps(0)
    maps.scores[:], maps.boxes[:] = -20, 0
    maps.scores[0, 10, 10], maps.scores[0, 10, 12] = 2.0, 1.0
    first, second = SPEC.anchors[10, 10, 0], SPEC.anchors[10, 12, 0]
    length, width, allowed = first[3], first[4], SPEC.post.nms_iou
    shift = length * (1 - allowed) / (1 + allowed)  # of two boxes in a row, whose overlap it makes the allowed one
    sides = []
    for factor in (1 - 1e-5, 1 + 1e-5, 1.02):
        boxes = maps.boxes.copy()
        boxes[0, 10, 12] = (first[0] + factor * shift - second[0]) / np.hypot(length, width)
        sides.append(maps._replace(boxes=boxes))
    suppressed, kept, apart = sides
    assert len(SPEC.decode(suppressed)) == 1 and len(SPEC.decode(kept)) == 2
    compare_boxes(suppressed, kept, FEW)
    with pytest.raises(ExportError, match="has no partner"):
        compare_boxes(suppressed, apart, FEW)


def test_parity_on_real_scans_on_the_papers_grid(tmp_path: Path) -> None:
    root = os.environ.get("ASCA_KITTI_MINI")
    if not root:
        pytest.skip("ASCA_KITTI_MINI is not set: no real scans here")
    split = KittiSplit(root)
    scans = [read_scan(split.scan_path(frame_id)).points for frame_id in split.frame_ids]
    parity = export_pillar_bundle(tiny_checkpoint("paper", PillarSpec()), tmp_path, scans).parity
    assert parity is not None and parity.scans == len(scans)
    assert parity.box_max_error_m <= 0.01 and parity.yaw_max_error_rad <= np.deg2rad(0.5)
