"""The loss of the second stage against the geometry, and by hand."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given

from asca_pillars.geometry.boxes import corners
from asca_pillars.models.two_stage.layers import Refinements
from asca_pillars.models.two_stage.loss import (
    RefineTargets,
    corner_loss,
    corners_in_frames,
    distance_iou_loss,
    refine_loss,
)
from asca_pillars.ops.two_stage.decode import boxes_in_frames, encode_refinement
from tests.ops.points.boxes_near import CHANGES, PROPOSALS, changed


@given(PROPOSALS, CHANGES)
def test_corners_are_those_of_the_decoded_box(
    proposal: np.ndarray, change: tuple[np.ndarray, np.ndarray, float]
) -> None:
    shift, scale, turn = change
    box = changed(proposal, (shift, scale, turn % 1.5))  # so that front stays front, and corner 0 corner 0
    residuals = torch.from_numpy(encode_refinement(box[None], proposal[None]))
    found = corners_in_frames(residuals, torch.from_numpy(proposal[None, 3:6]).float())
    expected = corners(boxes_in_frames(box[None], proposal[None]))
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-4)


def test_corner_loss_by_hand() -> None:
    sizes = torch.tensor([[3.0, 4.0, 2.0]] * 3)
    targets = torch.zeros(3, 7)
    residuals = targets.clone()
    residuals[0, 2] = 0.25  # half a metre up
    residuals[1, 0] = 0.6  # three metres ahead
    residuals[2, 6] = math.pi  # the same box, back to front
    assert corner_loss(residuals, targets, sizes).tolist() == pytest.approx([0.5**2 / 2, 3 - 0.5, 0], abs=1e-6)


def outputs(confidence: list[float], residuals: torch.Tensor, keypoints: list[float]) -> Refinements:
    return Refinements(torch.tensor(confidence), residuals, torch.tensor(keypoints))


def targets(confidence: list[float], positive: list[bool], states: list[int]) -> RefineTargets:
    count = len(confidence)
    return RefineTargets(
        torch.tensor(confidence, dtype=torch.float32),
        torch.tensor(positive),
        torch.zeros(count, 7),
        torch.ones(count, 3),
        torch.tensor(states, dtype=torch.int8),
    )


def test_only_what_takes_part_counts() -> None:
    wrong = torch.full((2, 7), 0.5)
    terms = refine_loss(outputs([20.0, -20.0], wrong, [20.0, -20.0, 3.0]), targets([1, 0], [False, False], [1, 0, -1]))
    assert terms.total.item() == pytest.approx(0, abs=1e-6)
    terms = refine_loss(outputs([0.0, 0.0], wrong, [0.0, 0.0, 0.0]), targets([1, 0], [True, False], [1, 0, -1]))
    assert terms.confidence.item() == pytest.approx(math.log(2))
    assert terms.residuals.item() == pytest.approx(7 * (0.5 - 1 / 18))
    # One right and one wrong of probability 1/2: (0.25 + 0.75) / 4 log 2.
    assert terms.keypoints.item() == pytest.approx(math.log(2) / 4)


def test_without_positives_a_loss_is_finite_and_does_not_outweigh_others() -> None:
    residuals = torch.zeros(2, 7, requires_grad=True)
    refine_loss(outputs([0.0, 0.0], residuals, [0.0]), targets([0, 0], [False, False], [0])).total.backward()
    assert residuals.grad is not None and torch.isfinite(residuals.grad).all()
    none, few = (
        refine_loss(outputs([0.0], torch.zeros(1, 7), [-2.0] * 1000), targets([0], [False], states)).keypoints.item()
        for states in ([0] * 1000, [1] * 10 + [0] * 990)
    )
    assert none < few


def test_distance_iou_of_boxes_equal_apart_and_one_in_the_other() -> None:
    sizes = torch.tensor([[4.0, 2.0, 1.5]]).double()
    here = torch.zeros(1, 7).double()
    assert distance_iou_loss(here, here, sizes) == 0
    beside = here.clone()
    beside[0, 0] = 8 / math.hypot(4, 2)  # eight metres ahead: they do not meet, and lie in 12 m by 2 m together
    assert distance_iou_loss(beside, here, sizes).item() == pytest.approx(1 + 64 / 148)
    inside = here.clone()
    inside[0, 3:5] = math.log(0.5)  # a quarter of the area, the same center
    assert distance_iou_loss(inside, here, sizes).item() == pytest.approx(0.75)
    assert distance_iou_loss(here[:0], here[:0], sizes[:0]).shape == (0,)


@pytest.mark.parametrize("moved", [0.3, 5.0])
def test_distance_iou_has_the_gradient_that_it_says(moved: float) -> None:
    torch.manual_seed(0)
    residuals = 0.2 * torch.randn(3, 7, dtype=torch.float64)
    residuals[:, 0] += moved
    targets, sizes = 0.1 * torch.randn(3, 7, dtype=torch.float64), torch.rand(3, 3, dtype=torch.float64) + 1
    assert torch.autograd.gradcheck(lambda each: distance_iou_loss(each, targets, sizes), residuals.requires_grad_())
    distance_iou_loss(residuals, targets, sizes).sum().backward()
    assert residuals.grad is not None and (residuals.grad[:, :2] != 0).all(), "also of boxes that do not meet"
