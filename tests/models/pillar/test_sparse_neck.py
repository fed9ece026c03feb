"""The sparse neck against dense convolutions with masks, in training and in evaluation."""

import dataclasses
import operator
from functools import partial
from typing import Literal

import numpy as np
import pytest
import torch
from torch import nn

from asca_pillars.base.errors import ConfigError
from asca_pillars.config.pillar import LossConfig, NetworkConfig, PillarModel
from asca_pillars.models.map_backbone import at_active_cells
from asca_pillars.models.pillar.loss import TargetBatch, detection_loss
from asca_pillars.models.pillar.neck import RPNNeck, SparseRPNNeck, block_layers
from asca_pillars.models.pillar.network import PillarDetector, PillarOutputs, build_pillar_detector
from asca_pillars.models.pillar.preparation import LabeledPillars, PillarBatch, Placement, batch_pillars
from asca_pillars.ops.pillar.neck_rulebooks import MaskRule, NeckRulebookBuilder
from tests.helpers.scenes import SPEC, make_scene
from tests.models.pillar.loss_scenes import batched, scene_targets

NETWORK = NetworkConfig(pillar_channels=8, block_channels=(8, 12, 16), block_convs=(2, 1, 1), upsample_channels=8)
RULES = ("sub", "fine")
UNSEEN_BY_SCORES = ("head.boxes.weight", "head.boxes.bias", "head.directions.weight", "head.directions.bias")


def make_detector(rule: MaskRule | None) -> PillarDetector:
    torch.manual_seed(0)
    network = NETWORK if rule is None else dataclasses.replace(NETWORK, neck="sparse", active_cells=rule)
    return build_pillar_detector(PillarModel(spec=SPEC, network=network))


def make_batch(rule: MaskRule | None, seeds: tuple[int, ...] = (0, 1), *, training: bool = True) -> PillarBatch:
    frames = [SPEC.pillarize(make_scene(seed)[0]) for seed in seeds]
    if rule is None:
        return batch_pillars(frames)
    builder = NeckRulebookBuilder(SPEC.grid.ny, SPEC.grid.nx, rule, training=training)
    return batch_pillars(frames, [Placement(None, builder.build(frame.cells)) for frame in frames])


def dense_rows(detector: PillarDetector, batch: PillarBatch) -> torch.Tensor:
    """The sparse neck's output, computed on whole maps."""
    features = detector.encode(batch.features, batch.pillar_index, batch.point_counts, batch.frame_pillars)
    canvas = detector.scatter(features, batch.cells, batch.frame_pillars)
    neck, rulebooks = detector.neck, batch.neck
    assert isinstance(neck, SparseRPNNeck) and rulebooks is not None
    maps = []
    for block, deblock, level in zip(neck.blocks, neck.deblocks, rulebooks.levels, strict=True):
        for number, (convolution, norm) in enumerate(block_layers(block)):
            cells = (level.cells if number else level.strided_cells).long()
            canvas, mask = masked(norm, convolution(canvas), cells)
        transposed, norm, _ = deblock.children()
        assert isinstance(transposed, nn.ConvTranspose2d)
        cells = nn.functional.interpolate(mask, scale_factor=transposed.stride).flatten().nonzero()[:, 0]
        everywhere, _ = masked(norm, transposed(canvas), cells)
        maps.append(everywhere.permute(0, 2, 3, 1).flatten(0, 2)[rulebooks.head_cells.long()])
    return torch.cat(maps, dim=1)


def masked(norm: nn.Module, canvas: torch.Tensor, cells: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Maps (B, C, h, w), normalized and rectified at these cells and zero elsewhere, and the mask (B, 1, h, w)."""
    rows = canvas.permute(0, 2, 3, 1).flatten(0, 2)
    active = torch.relu(at_active_cells(norm, rows[cells]))
    everywhere = torch.zeros_like(rows).index_put((cells,), active)
    mask = torch.zeros_like(rows[:, :1]).index_put((cells,), torch.ones_like(rows[cells, :1]))
    frames, _, height, width = canvas.shape
    maps = (part.view(frames, height, width, -1).permute(0, 3, 1, 2) for part in (everywhere, mask))
    return next(maps), next(maps)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("training", [False, True])
def test_tables_and_masks_are_the_same_function(rule: MaskRule, training: bool) -> None:
    detector, batch = make_detector(rule).double().train(training), make_batch(rule)
    batch = batch._replace(features=batch.features.double())
    names, parameters = zip(*detector.named_parameters(), strict=True)
    found = detector(batch).scores
    expected = detector.head.at_cells(dense_rows(detector, batch)).scores
    gradients, expected_gradients = (
        torch.autograd.grad(scores.square().sum(), parameters, allow_unused=True) for scores in (found, expected)
    )
    assert len(found) > 100 and found.std() > 0.01
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)
    for name, one, other in zip(names, gradients, expected_gradients, strict=True):
        if name not in UNSEEN_BY_SCORES:
            torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-8, msg=partial(operator.add, name))


def test_where_everything_is_active_it_is_the_dense_neck() -> None:
    # One pillar in every cell; statistics over active cells are then those over the map.
    dense, sparse = make_detector(None).train().double(), make_detector("fine").train().double()
    sparse.load_state_dict(dense.state_dict())  # the same names and shapes
    ny, nx = SPEC.grid.ny, SPEC.grid.nx
    features = torch.randn(ny * nx, 8, dtype=torch.float64)
    rulebooks = NeckRulebookBuilder(ny, nx, "fine").build(np.arange(ny * nx))
    (batch,) = [batch_pillars([SPEC.pillarize(make_scene(0)[0])], [Placement(None, rulebooks)])]
    assert isinstance(sparse.neck, SparseRPNNeck) and isinstance(dense.neck, RPNNeck) and batch.neck is not None
    with torch.no_grad():
        expected = dense.neck(features.view(1, ny, nx, 8).permute(0, 3, 1, 2))
        found = sparse.neck(features, batch.neck)
    torch.testing.assert_close(found, expected[0].permute(1, 2, 0).flatten(0, 1))


def test_frames_of_a_batch_do_not_touch() -> None:
    detector, spec = make_detector("fine").eval(), SPEC.with_score_threshold(0.0)
    with torch.inference_mode():
        batch = make_batch("fine", (0, 1, 2))
        together = detector.detect(PillarOutputs(detector(batch), batch.neck), spec)
        for seed, found in enumerate(together):
            alone = make_batch("fine", (seed,))
            (own,) = detector.detect(PillarOutputs(detector(alone), alone.neck), spec)
            assert len(found) == len(own) > 0
            np.testing.assert_allclose(found.scores, own.scores, atol=1e-5)
            np.testing.assert_allclose(found.boxes, own.boxes, atol=1e-4)
            np.testing.assert_array_equal(found.labels, own.labels)


@pytest.mark.parametrize("score_target", ["one", "iou"])
def test_the_loss_is_that_of_the_active_anchors(score_target: Literal["one", "iou"]) -> None:
    batch, detector = make_batch("fine"), make_detector("fine").eval()
    detector.loss_weights = LossConfig(score_target=score_target)
    whole = batched([scene_targets(seed)[2] for seed in (0, 1)])
    assert batch.neck is not None
    cells = batch.neck.head_cells.long()
    with torch.inference_mode():
        rows = detector(batch)
    found = list(detector.loss(PillarOutputs(rows, batch.neck), LabeledPillars(batch, whole)).values())
    # The same on whole maps, in which no other anchor takes part.
    height, width = SPEC.grid.head_shape
    maps = [torch.zeros(2 * height * width, part.shape[1]) for part in rows]
    for part, row in zip(maps, rows, strict=True):
        part[cells] = row
    active = torch.zeros(2 * height * width, dtype=torch.bool)
    active[cells] = True
    anchors = whole.state.shape[-1]
    kept = active[whole.positives // anchors]
    assert 0 < kept.sum() <= len(kept)
    state = torch.where(active.view(2, height, width, 1), whole.state, torch.tensor(-1, dtype=torch.int8))
    masked = TargetBatch(state, *(part[kept] for part in whole[1:]))
    as_maps = type(rows)(*(part.view(2, height, width, -1).permute(0, 3, 1, 2) for part in maps))
    for one, other in zip(found, detection_loss(as_maps, masked, detector.loss_weights), strict=True):
        torch.testing.assert_close(one, other)


def test_a_rule_that_cannot_grow_is_refused() -> None:
    with pytest.raises(ConfigError, match="active_cells=sub"):
        dataclasses.replace(NETWORK, neck="sparse", block_convs=(0, 1, 1))
    dataclasses.replace(NETWORK, neck="sparse", block_convs=(0, 1, 1), active_cells="sub")
