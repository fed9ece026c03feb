"""The second stage as a whole: shapes, batches, and one frame learnt by heart."""

import numpy as np
import pytest
import torch

from asca_pillars.detection.decode import PostProcess
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.overlap import iou_3d
from asca_pillars.models.two_stage.loss import refine_loss
from asca_pillars.models.two_stage.network import refine
from asca_pillars.models.two_stage.preparation import collate_samples, collate_scans
from asca_pillars.ops.two_stage.first_stage import SecondStageInputs
from asca_pillars.ops.two_stage.prepare import refine_scan
from tests.models.two_stage.small_refiner import (
    LABELS,
    NAMES,
    SETTINGS,
    batch,
    prepare_sample,
    proposed_frame,
    small_refiner,
)


def test_an_untrained_head_hardly_moves_proposals() -> None:
    assert small_refiner().eval()(batch((0,)).inputs).residuals.abs().max() < 0.05


def test_a_batch_of_two_is_two_batches_of_one() -> None:
    network = small_refiner().eval()
    scans = [refine_scan(f.points, p, p.proposals, SETTINGS) for f, p in map(proposed_frame, (0, 1))]
    with torch.inference_mode():
        together = network(collate_scans(scans))
        alone = [network(collate_scans([scan])) for scan in scans]
    for joined, *parts in zip(together, *alone, strict=True):
        torch.testing.assert_close(joined, torch.cat(parts), atol=1e-5, rtol=1e-5)


def test_every_weight_learns() -> None:
    network = small_refiner()
    inputs, targets = batch((0, 1))
    refine_loss(network(inputs), targets).total.backward()
    still = [name for name, weight in network.named_parameters() if weight.grad is None or not weight.grad.any()]
    assert not still


def test_learns_one_frame_by_heart() -> None:
    network, (frame, proposed) = small_refiner(), proposed_frame(5)
    rng = np.random.default_rng(0)
    optimizer = torch.optim.Adam(network.parameters(), lr=5e-3)
    for _ in range(150):
        sample = collate_samples([prepare_sample(frame, proposed, SETTINGS, 16, rng)])
        loss = refine_loss(network(sample.inputs), sample.targets).total
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    found = refine(network.eval(), frame.points, proposed, SETTINGS, PostProcess(), "second")
    overlap = iou_3d(found.boxes, frame.boxes)
    best = overlap.argmax(axis=0)
    before = iou_3d(proposed.proposals.boxes, frame.boxes).max(axis=0)
    assert overlap[best, range(4)].mean() > max(before.mean(), 0.85)
    assert (found.labels[best] == LABELS).all()
    assert set(best) == {0, 1, 2, 3}, "the best four are the objects"


def test_a_scan_without_proposals() -> None:
    frame, proposed = proposed_frame(0)
    nothing = SecondStageInputs(Detections.empty(NAMES), proposed.keypoints[:0], proposed.bev[:0])
    assert len(refine(small_refiner().eval(), frame.points, nothing, SETTINGS, PostProcess(), "second")) == 0
    sample = prepare_sample(frame, nothing, SETTINGS, 16, np.random.default_rng(0))
    assert len(sample.targets.rois) == 0


@pytest.mark.parametrize("seeds", [(0, 1), (1, 0)])
def test_a_frame_without_samples_in_a_batch(seeds: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    samples = []
    for seed in seeds:
        frame, proposed = proposed_frame(seed)
        if seed:
            proposed = SecondStageInputs(Detections.empty(NAMES), proposed.keypoints[:0], proposed.bev[:0])
        samples.append(prepare_sample(frame, proposed, SETTINGS, 16, rng))
    inputs, targets = collate_samples(samples)
    assert torch.isfinite(refine_loss(small_refiner()(inputs), targets).total)
