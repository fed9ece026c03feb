"""Scores that say how well their boxes fit (`score_target: iou`): formula, gradients, overlaps, one frame learnt."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from asca_pillars.config.pillar import LossConfig, NetworkConfig, PillarModel
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.geometry.boxes import decode_boxes
from asca_pillars.geometry.overlap import iou_3d
from asca_pillars.models.pillar.loss import (
    TargetBatch,
    detection_loss,
    focal_loss,
    overlaps_found,
    quality_focal_loss,
    states_by_class,
)
from asca_pillars.models.pillar.network import build_pillar_detector
from asca_pillars.models.pillar.preparation import LabeledPillars, batch_pillars, batch_targets
from tests.helpers.scenes import SPEC, make_scene
from tests.models.pillar.loss_scenes import COUNT, NO_TARGETS, batched, noisy_maps, perfect_maps, scene_targets

ONE, IOU = LossConfig(), LossConfig(score_target="iou")


def quality_loss(logit: float, state: int, quality: float, alpha: float = 0.25, gamma: float = 2.0) -> float:
    """Of one anchor."""
    logits, states = torch.tensor([[logit]], dtype=torch.float64), torch.tensor([[state]], dtype=torch.int8)
    return quality_focal_loss(logits, states, torch.tensor([[quality]], dtype=torch.float64), alpha, gamma).item()


def positive_rows(maps: HeadMaps[Tensor], targets: TargetBatch) -> tuple[Tensor, Tensor]:
    """Residuals (n, 7) and logits (n,) of the positive anchors of whole maps."""
    boxes = maps.boxes.permute(0, 2, 3, 1).reshape(-1, 7)
    scores = maps.scores.permute(0, 2, 3, 1).reshape(-1)
    return boxes[targets.positives], scores[targets.positives]


def test_by_hand() -> None:
    """0.25 |y - p|^2 (-y ln p - (1 - y) ln(1 - p)) for an object of quality y, background as in eq. (14).

    p = 1/2, y = 3/4: 0.25 * 1/16 * ln 2                                 = 0.0108304.
    p = 3/4, y = 1/2: 0.25 * 1/16 * (0.5 ln(4/3) + 0.5 ln 4)             = 0.0130780.
    p = 3/4, y = 3/4: nothing. Background, p = 3/4: 0.75 * 9/16 * ln 4   = 0.5848429, whatever the quality.
    """
    cases = [(0.0, 1, 0.75), (math.log(3), 1, 0.5), (math.log(3), 1, 0.75), (math.log(3), 0, 0.9), (2.0, -1, 0.4)]
    found = [quality_loss(*case) for case in cases]
    np.testing.assert_allclose(found, [0.0108304, 0.0130780, 0, 0.5848429, 0], rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize(("alpha", "gamma"), [(0.25, 2.0), (0.6, 1.0), (0.5, 0.0), (0.3, 1.5)])
def test_equals_the_plain_formula(alpha: float, gamma: float) -> None:
    rng = np.random.default_rng(1)
    logits, states, qualities = rng.normal(0, 3, (40, 3)), rng.integers(-1, 2, (40, 3)), rng.uniform(0, 1, (40, 1))
    expected = 0.0
    for place in np.ndindex(logits.shape):
        p = 1 / (1 + math.exp(-logits[place]))
        y = qualities[place[0], 0] if states[place] == 1 else 0.0
        if states[place] >= 0:
            weight = alpha if states[place] == 1 else 1 - alpha
            expected -= weight * abs(y - p) ** gamma * ((1 - y) * math.log(1 - p) + y * math.log(p))
    parts = (torch.from_numpy(logits), torch.from_numpy(states.astype(np.int8)), torch.from_numpy(qualities))
    assert quality_focal_loss(*parts, alpha, gamma).item() == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("gamma", [2.0, 1.0, 0.0])
def test_quality_one_is_the_focal_loss(gamma: float) -> None:
    generator = torch.Generator().manual_seed(0)
    logits = 4 * torch.randn(200, 1, generator=generator, dtype=torch.float64)
    states = torch.randint(-1, 2, (200, 1), generator=generator, dtype=torch.int8)
    found = quality_focal_loss(logits, states, torch.ones_like(logits), 0.25, gamma)
    torch.testing.assert_close(found, focal_loss(logits, states, 0.25, gamma))


@pytest.mark.parametrize("gamma", [2.0, 1.5])
def test_gradients_are_those_of_finite_differences(gamma: float) -> None:
    generator = torch.Generator().manual_seed(0)
    logits = torch.randn(12, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    states = torch.randint(-1, 2, (12, 3), generator=generator, dtype=torch.int8)
    quality = torch.rand(12, 1, generator=generator, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: quality_focal_loss(x, states, quality, 0.25, gamma), logits)


@given(st.floats(-6, 6), st.floats(0, 1))
def test_scores_are_drawn_towards_the_quality(logit: float, quality: float) -> None:
    logits = torch.tensor([[logit]], dtype=torch.float64, requires_grad=True)
    wanted = torch.tensor([[quality]], dtype=torch.float64)
    quality_focal_loss(logits, torch.ones(1, 1, dtype=torch.int8), wanted, 0.25, 2.0).backward()
    assert logits.grad is not None
    difference = torch.sigmoid(logits.detach()) - wanted
    assert (logits.grad * difference >= 0).all()
    if difference.abs() > 1e-3:
        assert logits.grad != 0


@pytest.mark.parametrize("gamma", [2.0, 1.0, 0.0])
def test_extreme_logits_and_exact_scores_have_finite_gradients(gamma: float) -> None:
    logits = torch.tensor([1e4, -1e4, 1e4, -1e4, 0.0])[:, None].requires_grad_()
    states = torch.tensor([1, 0, 0, 1, 1], dtype=torch.int8)[:, None]
    loss = quality_focal_loss(logits, states, torch.tensor([1.0, 0, 0, 0.5, 0.5])[:, None], 0.25, gamma)
    loss.backward()
    assert logits.grad is not None and logits.grad.isfinite().all() and loss.isfinite()


def test_overlaps_by_hand() -> None:
    """A box that is its anchor, moved by a tenth of the diagonal; raised by a quarter; half as long; turned."""
    anchors = torch.tensor([[10.0, 2.0, -1.0, 4.0, 3.0, 1.6, 0.0]]).repeat(6, 1)
    wanted, found = torch.zeros(6, 7), torch.zeros(6, 7)
    found[1, 0] = 0.1  # 0.5 m of 4: 3.5 / 4.5
    found[2, 2] = 0.25  # 0.75 / 1.25
    found[3, 3] = math.log(0.5)
    found[4, 6] = math.pi  # the direction bins tell it apart, not the overlap
    found[5, 6] = math.pi / 2  # 3 x 3 of 4 x 3 and 3 x 4
    batch = TargetBatch(torch.zeros(1), torch.arange(6), anchors, wanted, torch.zeros(6, dtype=torch.int64))
    expected = [1, 3.5 / 4.5, 0.6, 0.5, 1, 9 / 15]
    np.testing.assert_allclose(overlaps_found(found, batch).numpy(), expected, rtol=1e-5)


@given(st.integers(0, 2**32 - 1))
def test_overlaps_are_those_of_the_decoded_boxes(seed: int) -> None:
    boxes, _, targets = scene_targets(seed % 20)
    batch = batched([targets])
    noise = torch.randn(batch.residuals.shape, generator=torch.Generator().manual_seed(seed))
    residuals = (batch.residuals + 0.2 * noise).requires_grad_()
    found = overlaps_found(residuals, batch)
    assert found.dtype == torch.float32 and not found.requires_grad
    predicted = decode_boxes(residuals.detach().numpy(), targets.directions, targets.anchors)
    expected = iou_3d(predicted, boxes)[np.arange(len(predicted)), targets.matched]
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-4)


def test_what_overflows_overlaps_nothing() -> None:
    batch = batched([scene_targets(0)[2]])
    for value in (math.nan, math.inf, -math.inf, 1e38):
        found = overlaps_found(torch.full_like(batch.residuals, value), batch)
        assert not found.any()


def test_one_is_the_default_and_what_it_was() -> None:
    """Every term to the last bit as eq. (13)-(15) were computed before there was a choice."""
    frames = [scene_targets(seed)[2] for seed in (6, 7)]
    maps, batch = noisy_maps(2), batched(frames)
    assert ONE.score_target == "one"
    terms = detection_loss(maps, batch, ONE)
    logits = maps.scores.permute(0, 2, 3, 1).reshape(-1, 1)
    expected = focal_loss(logits, batch.state.reshape(-1, 1), 0.25, 2.0)
    assert terms.classification.item() == (expected / len(batch.positives)).item()
    other = detection_loss(maps, batch, IOU)
    assert (other.box.item(), other.direction.item()) == (terms.box.item(), terms.direction.item())
    assert other.classification.item() != terms.classification.item()


@pytest.mark.parametrize("scores", [1, 3])
def test_the_class_term_is_that_of_the_overlaps(scores: int) -> None:
    """With a score for each class the overlap is wanted in the column of the anchor's own class alone."""
    frames = [scene_targets(seed)[2] for seed in (6, 7)]
    maps, batch = noisy_maps(2), batched(frames)
    maps = maps._replace(
        boxes=(perfect_maps(frames).boxes + 0.1 * maps.boxes).detach(), scores=maps.scores.repeat(1, scores, 1, 1)
    )
    found = detection_loss(maps, batch, IOU).classification.item() * len(batch.positives)
    states = states_by_class(batch.state, scores)
    rows = maps.scores.permute(0, 2, 3, 1).reshape(-1, scores)
    background = focal_loss(torch.where(states == 1, -1e4, rows), torch.where(states == 1, 0, states), 0.25, 2.0)
    overlaps = overlaps_found(positive_rows(maps, batch)[0], batch)
    assert 0.05 < overlaps.mean() < 0.95
    own = batch.positives % COUNT // 2 if scores == 3 else torch.zeros_like(batch.positives)
    logits = rows[batch.positives, own][:, None]
    objects = quality_focal_loss(logits, torch.ones_like(logits, dtype=torch.int8), overlaps[:, None], 0.25, 2.0)
    assert found == pytest.approx((background + objects).item(), rel=1e-5)


def test_boxes_do_not_learn_from_the_class_term() -> None:
    frame = scene_targets(6)[2]
    maps = noisy_maps(1)
    detection_loss(maps, batched([frame]), IOU).classification.backward()
    assert maps.boxes.grad is None and maps.directions.grad is None and maps.scores.grad is not None


def test_frames_without_positives() -> None:
    maps = noisy_maps(2)
    terms, expected = (detection_loss(maps, batched([NO_TARGETS, NO_TARGETS]), config) for config in (IOU, ONE))
    torch.testing.assert_close(terms.classification, expected.classification)


def test_one_frame_is_learnt_until_scores_say_how_well_boxes_fit() -> None:
    """Without the box term boxes stay about their anchors, which fit some objects well and others badly."""
    torch.manual_seed(0)
    network = NetworkConfig(
        pillar_channels=16, block_channels=(16, 24, 32), block_convs=(1, 1, 1), upsample_channels=16
    )
    detector = build_pillar_detector(
        PillarModel(spec=SPEC, network=network, loss=dataclasses.replace(IOU, box_weight=0))
    )
    points, _, _ = make_scene(0)
    targets = scene_targets(0)[2]
    batch = LabeledPillars(batch_pillars([SPEC.pillarize(points)]), batch_targets([targets]))
    optimizer = torch.optim.Adam(detector.parameters(), lr=3e-3)
    for _ in range(80):
        optimizer.zero_grad()
        torch.stack(list(detector.loss(detector.predict(batch), batch).values())).sum().backward()
        optimizer.step()
    with torch.no_grad():
        residuals, logits = positive_rows(detector(batch.pillars), batch.targets)
    overlaps, scores = overlaps_found(residuals, batch.targets), torch.sigmoid(logits)
    assert overlaps.std() > 0.05
    assert (scores - overlaps).abs().max() < 0.03
