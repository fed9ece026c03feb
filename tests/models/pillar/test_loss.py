"""The loss against hand-derived numbers and plain formulas, and the way targets -> maps -> loss and decode closed."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from asca_pillars.config.pillar import LossConfig
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.geometry.boxes import wrap_angle
from asca_pillars.models.pillar.loss import LossTerms, box_loss, detection_loss, focal_loss
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

CONFIG = LossConfig()


def test_focal_loss_by_hand() -> None:
    """Eq. (14), -alpha_t (1 - p_t)^2 ln p_t, alpha_t 0.25 for an object and 0.75 for background.

    Logit 0 is p = 1/2:          object 0.25 * 1/4 * ln 2       = 0.0433217, background 0.75 * 1/4 * ln 2  = 0.1299651.
    Logit ln 3 is p = 3/4:       object 0.25 * 1/16 * ln(4/3)   = 0.0044950, background 0.75 * 9/16 * ln 4 = 0.5848429.
    """
    logits = torch.tensor([0.0, 0.0, math.log(3), math.log(3)])
    found = [
        focal_loss(logits[i : i + 1], torch.tensor([state], dtype=torch.int8), 0.25, 2.0).item()
        for i, state in enumerate((1, 0, 1, 0))
    ]
    np.testing.assert_allclose(found, [0.0433217, 0.1299651, 0.0044950, 0.5848429], rtol=1e-5)


@pytest.mark.parametrize(("alpha", "gamma"), [(0.25, 2.0), (0.6, 1.0), (0.5, 0.0)])
def test_focal_loss_equals_the_plain_formula(alpha: float, gamma: float) -> None:
    rng = np.random.default_rng(1)
    logits, state = rng.normal(0, 3, (2, 5, 4, 6)), rng.integers(-1, 2, (2, 5, 4, 6))
    expected = 0.0
    for logit, wanted in zip(logits.flat, state.flat, strict=True):
        p = 1 / (1 + math.exp(-logit))
        if wanted == 1:
            expected -= alpha * (1 - p) ** gamma * math.log(p)
        elif wanted == 0:
            expected -= (1 - alpha) * p**gamma * math.log(1 - p)
    found = focal_loss(torch.from_numpy(logits), torch.from_numpy(state.astype(np.int8)), alpha, gamma)
    assert found.item() == pytest.approx(expected, rel=1e-6)


def test_focal_loss_of_extreme_logits() -> None:
    """Sure and wrong costs alpha_t |logit|, sure and right nothing; neither overflows, nor do the gradients."""
    logits = torch.tensor([1e4, -1e4, 1e4, -1e4], requires_grad=True)
    loss = focal_loss(logits, torch.tensor([1, 0, 0, 1], dtype=torch.int8), 0.25, 2.0)
    loss.backward()
    assert loss.item() == pytest.approx(0.75e4 + 0.25e4)
    assert logits.grad is not None
    np.testing.assert_allclose(logits.grad.numpy(), [0, 0, 0.75, -0.25], atol=1e-6)


def test_ignored_anchors_take_no_part() -> None:
    logits = torch.randn(3, 4, 5, 6, generator=torch.Generator().manual_seed(0)).requires_grad_()
    state = torch.from_numpy(np.random.default_rng(0).integers(-1, 2, (3, 4, 5, 6)).astype(np.int8))
    loss = focal_loss(logits, state, 0.25, 2.0)
    loss.backward()
    assert logits.grad is not None
    assert (logits.grad[state == -1] == 0).all() and (logits.grad[state >= 0] != 0).all()
    changed = torch.where(state == -1, torch.full_like(logits, 50.0), logits)
    assert focal_loss(changed, state, 0.25, 2.0).item() == loss.item()


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


def test_half_a_turn_is_a_matter_of_direction_alone() -> None:
    _, _, targets = scene_targets(0)
    batch, right = batched([targets]), perfect_maps([targets])
    half_turn = torch.zeros(7 * COUNT)
    half_turn[6::7] = math.pi
    turned = right._replace(boxes=right.boxes + half_turn[:, None, None])
    assert detection_loss(turned, batch, CONFIG).box.item() == pytest.approx(0, abs=1e-9)
    swapped = right._replace(directions=-right.directions)  # the other bin is ahead by the margin of 30
    terms = detection_loss(swapped, batch, CONFIG)
    assert terms.box.item() == 0 and terms.direction.item() == pytest.approx(0.2 * 30)


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
