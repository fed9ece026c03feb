"""The loss against plain formulas and by hand, scores that say how well boxes fit, and targets -> maps -> decode."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from asca_pillars.config.pillar import LossConfig
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.geometry.boxes import decode_boxes, wrap_angle
from asca_pillars.geometry.overlap import iou_3d
from asca_pillars.models.pillar.loss import (
    LossTerms,
    TargetBatch,
    box_loss,
    detection_loss,
    focal_loss,
    predicted_ious,
    quality_focal_loss,
    states_by_class,
)
from tests.helpers.scenes import SPEC
from tests.models.pillar.loss_scenes import (
    COLUMNS,
    COUNT,
    NO_TARGETS,
    ROWS,
    batched,
    noisy_maps,
    perfect_maps,
    scene_targets,
)

CONFIG, IOU = LossConfig(), LossConfig(score_target="iou")


@pytest.mark.parametrize(("alpha", "gamma"), [(0.25, 2.0), (0.6, 1.0), (0.5, 0.0), (0.3, 1.5)])
def test_focal_losses_are_the_plain_formulas(alpha: float, gamma: float) -> None:
    """Eq. (14), -alpha_t (1 - p_t)^gamma ln p_t, where an object of quality y has |y - p|^gamma times the entropy."""
    rng = np.random.default_rng(1)
    logits, states, qualities = rng.normal(0, 3, (40, 3)), rng.integers(-1, 2, (40, 3)), rng.uniform(0, 1, (40, 1))
    given = torch.from_numpy(logits), torch.from_numpy(states.astype(np.int8))

    def expected(qualities: np.ndarray) -> float:
        total = 0.0
        for place in np.ndindex(logits.shape):
            p, y = 1 / (1 + math.exp(-logits[place])), qualities[place[0], 0] if states[place] == 1 else 0.0
            if states[place] >= 0:
                weight = alpha if states[place] == 1 else 1 - alpha
                total -= weight * abs(y - p) ** gamma * ((1 - y) * math.log(1 - p) + y * math.log(p))
        return total

    found = quality_focal_loss(*given, torch.from_numpy(qualities), alpha, gamma).item()
    assert found == pytest.approx(expected(qualities), rel=1e-6)
    assert focal_loss(*given, alpha, gamma).item() == pytest.approx(expected(np.ones((40, 1))), rel=1e-6)


@pytest.mark.parametrize("gamma", [2.0, 1.5])
def test_gradients_of_the_quality_loss_are_those_of_finite_differences(gamma: float) -> None:
    generator = torch.Generator().manual_seed(0)
    logits = torch.randn(12, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    states = torch.randint(-1, 2, (12, 3), generator=generator, dtype=torch.int8)
    quality = torch.rand(12, 1, generator=generator, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: quality_focal_loss(x, states, quality, 0.25, gamma), logits)


def test_focal_loss_of_extreme_logits() -> None:
    """Sure and wrong costs alpha_t |logit|, sure and right nothing; neither overflows, nor do the gradients."""
    logits = torch.tensor([1e4, -1e4, 1e4, -1e4], requires_grad=True)
    loss = focal_loss(logits, torch.tensor([1, 0, 0, 1], dtype=torch.int8), 0.25, 2.0)
    loss.backward()
    assert loss.item() == pytest.approx(0.75e4 + 0.25e4)
    assert logits.grad is not None
    np.testing.assert_allclose(logits.grad.numpy(), [0, 0, 0.75, -0.25], atol=1e-6)
    scores = torch.tensor([1.0, 0, 0, 0.5, 0.5])[:, None]  # and what is wanted of them exactly
    for gamma in (2.0, 1.0, 0.0):
        rows = torch.tensor([1e4, -1e4, 1e4, -1e4, 0.0])[:, None].requires_grad_()
        states = torch.tensor([1, 0, 0, 1, 1], dtype=torch.int8)[:, None]
        loss = quality_focal_loss(rows, states, scores, 0.25, gamma)
        loss.backward()
        assert rows.grad is not None and rows.grad.isfinite().all() and loss.isfinite()


def test_box_loss_by_hand() -> None:
    """Smooth L1 with beta 1/9: d^2 / (2 beta) below beta, d - beta / 2 above.

    0.05 -> 0.0025 * 4.5 = 0.01125; -1 -> 1 - 1/18 = 0.944444; a yaw off by 90 degrees -> sine 1 -> 0.944444;
    off by 30 degrees -> sine 0.5 -> 0.5 - 1/18 = 0.444444.
    """
    targets = torch.tensor([[0.1, -0.2, 0.3, 0.4, -0.5, 0.6, 1.0]]).repeat(4, 1)
    residuals = targets.clone()
    residuals[0, 2] += 0.05
    residuals[1, 5] -= 1
    residuals[2, 6] += math.pi / 2
    residuals[3, 6] -= math.pi / 6
    found = [box_loss(residuals[i : i + 1], targets[i : i + 1], 1 / 9).item() for i in range(4)]
    np.testing.assert_allclose(found, [0.01125, 0.944444, 0.944444, 0.444444], rtol=1e-5)
    assert box_loss(residuals, targets, 1 / 9).item() == pytest.approx(sum(found))


def test_direction_by_hand() -> None:
    """Two bins that are equal cost ln 2 for each positive, a right one ahead by ln 3 costs ln(4/3)."""
    _, _, targets = scene_targets(0)
    batch = batched([targets])
    equal = perfect_maps([targets], margin=0)
    assert detection_loss(equal, batch, CONFIG).direction.item() == pytest.approx(0.2 * math.log(2), rel=1e-5)
    ahead = perfect_maps([targets], margin=math.log(3))
    assert detection_loss(ahead, batch, CONFIG).direction.item() == pytest.approx(0.2 * math.log(4 / 3), rel=1e-5)


def test_perfect_maps_cost_nothing_and_decode_to_the_labels() -> None:
    """Targets, the loss and the runtime's decoder read the same channels of the same anchors."""
    scenes = [scene_targets(seed) for seed in (3, 4, 5)]
    frames = [targets for _, _, targets in scenes]
    maps = perfect_maps(frames)
    terms = detection_loss(maps, batched(frames), CONFIG)
    np.testing.assert_allclose([term.item() for term in terms], 0, atol=1e-6)
    for i, (boxes, labels, _) in enumerate(scenes):
        detections = SPEC.decode(HeadMaps(*(part[i].numpy() for part in maps)))
        assert len(detections) == len(boxes)
        order, wanted = np.argsort(detections.boxes[:, 0]), np.argsort(boxes[:, 0])
        assert detections.labels[order].tolist() == labels[wanted].tolist()
        np.testing.assert_allclose(detections.boxes[order, :6], boxes[wanted, :6], rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(wrap_angle(detections.boxes[order, 6] - boxes[wanted, 6]), 0, atol=1e-5)


def test_gradients_reach_the_channels_of_positive_anchors_alone() -> None:
    frames = [scene_targets(seed)[2] for seed in (6, 7)]
    maps = noisy_maps(2)
    detection_loss(maps, batched(frames), CONFIG).total.backward()
    for part, values in ((maps.boxes, 7), (maps.directions, 2)):
        assert part.grad is not None
        for i, frame in enumerate(frames):
            expected = np.zeros((values * COUNT, ROWS, COLUMNS), bool)
            for row, column, anchor in np.argwhere(frame.state == 1):
                expected[values * anchor : values * (anchor + 1), row, column] = True
            np.testing.assert_array_equal(part.grad[i].numpy() != 0, expected)


def test_all_terms_are_per_positive_anchor() -> None:
    """Two equal frames cost what one does; and each term carries its weight."""
    frame = scene_targets(8)[2]
    maps = noisy_maps(1)
    twice = HeadMaps(*(part.detach().repeat(2, 1, 1, 1) for part in maps))
    one, two = detection_loss(maps, batched([frame]), CONFIG), detection_loss(twice, batched([frame, frame]), CONFIG)
    for term, other in zip(one, two, strict=True):
        assert term.item() == pytest.approx(other.item(), rel=1e-5) and term.item() > 0
    logits = maps.scores.permute(0, 2, 3, 1)
    summed = focal_loss(logits, torch.from_numpy(frame.state)[None], 0.25, 2.0)
    assert one.classification.item() == pytest.approx(summed.item() / len(frame.positives), rel=1e-5)
    plain = detection_loss(
        maps, batched([frame]), dataclasses.replace(CONFIG, box_weight=1, class_weight=1, direction_weight=1)
    )
    np.testing.assert_allclose(
        [term.item() for term in one], np.multiply([2, 1, 0.2], [term.item() for term in plain]), rtol=1e-6
    )
    assert one.total.item() == pytest.approx(sum(term.item() for term in one), rel=1e-6)


def test_a_frame_without_positives() -> None:
    maps = noisy_maps(2)
    frame = scene_targets(9)[2]
    terms = detection_loss(maps, batched([NO_TARGETS, NO_TARGETS]), CONFIG)
    assert (terms.box.item(), terms.direction.item()) == (0, 0) and terms.classification.item() > 0
    terms.total.backward()
    assert all(part.grad is not None and part.grad.isfinite().all() for part in maps)
    # Behind an empty frame the positives of the next one are found where they are.
    second = detection_loss(perfect_maps([NO_TARGETS, frame]), batched([NO_TARGETS, frame]), CONFIG)
    np.testing.assert_allclose([term.item() for term in second], 0, atol=1e-6)


def test_half_precision_maps_are_summed_in_full() -> None:
    frame = scene_targets(10)[2]
    maps = HeadMaps(*(part.detach().bfloat16() for part in noisy_maps(1)))
    terms: LossTerms = detection_loss(maps, batched([frame]), CONFIG)
    expected = detection_loss(HeadMaps(*(part.float() for part in maps)), batched([frame]), CONFIG)
    for term, other in zip(terms, expected, strict=True):
        assert term.dtype == torch.float32 and term.item() == other.item()


def positive_rows(maps: HeadMaps[Tensor], targets: TargetBatch) -> tuple[Tensor, Tensor]:
    """Residuals (n, 7) and logits (n,) of the positive anchors of whole maps."""
    boxes = maps.boxes.permute(0, 2, 3, 1).reshape(-1, 7)
    scores = maps.scores.permute(0, 2, 3, 1).reshape(-1)
    return boxes[targets.positives], scores[targets.positives]


@given(st.integers(0, 2**32 - 1))
def test_overlaps_are_those_of_the_decoded_boxes(seed: int) -> None:
    boxes, _, targets = scene_targets(seed % 20)
    batch = batched([targets])
    noise = torch.randn(batch.residuals.shape, generator=torch.Generator().manual_seed(seed))
    residuals = (batch.residuals + 0.2 * noise).requires_grad_()
    found = predicted_ious(residuals, batch)
    assert found.dtype == torch.float32 and not found.requires_grad
    predicted = decode_boxes(residuals.detach().numpy(), targets.directions, targets.anchors)
    expected = iou_3d(predicted, boxes)[np.arange(len(predicted)), targets.matched]
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-4)


def test_what_overflows_overlaps_nothing() -> None:
    batch = batched([scene_targets(0)[2]])
    for value in (math.nan, math.inf, -math.inf, 1e38):
        found = predicted_ious(torch.full_like(batch.residuals, value), batch)
        assert not found.any()


@pytest.mark.parametrize("scores", [1, 3])
def test_the_class_term_is_that_of_the_overlaps(scores: int) -> None:
    """With a score for each class the overlap is wanted in the column of the anchor's own class alone."""
    frames = [scene_targets(seed)[2] for seed in (6, 7)]
    maps, batch = noisy_maps(2), batched(frames)
    maps = maps._replace(
        boxes=(perfect_maps(frames).boxes + 0.1 * maps.boxes).detach(), scores=maps.scores.repeat(1, scores, 1, 1)
    )
    terms, plain = detection_loss(maps, batch, IOU), detection_loss(maps, batch, CONFIG)
    assert (terms.box, terms.direction) == (plain.box, plain.direction)
    found = terms.classification.item() * len(batch.positives)
    states = states_by_class(batch.state, scores)
    rows = maps.scores.permute(0, 2, 3, 1).reshape(-1, scores)
    background = focal_loss(torch.where(states == 1, -1e4, rows), torch.where(states == 1, 0, states), 0.25, 2.0)
    overlaps = predicted_ious(positive_rows(maps, batch)[0], batch)
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
