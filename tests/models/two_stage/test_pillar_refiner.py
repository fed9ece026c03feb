"""The second stage as a whole: the gate of features, shapes, batches, and one frame learnt by heart."""

import numpy as np
import torch
from numpy.typing import NDArray

from asca_pillars.detection.decode import PostProcess
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.overlap import iou_3d
from asca_pillars.models.two_stage.layers import BallSource, ContextGate, KeypointEncoder, SourceRows
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
    assert small_refiner().eval()(inputs).residuals.abs().max() < 0.05, "untrained, proposals hardly move"
    refine_loss(network(inputs), targets).total.backward()
    still = [name for name, weight in network.named_parameters() if weight.grad is None or not weight.grad.any()]
    assert not still


def test_learns_one_frame_by_heart() -> None:
    network, (frame, proposed) = small_refiner(), proposed_frame(5)
    rng = np.random.default_rng(0)
    optimizer = torch.optim.Adam(network.parameters(), lr=5e-3)
    for _ in range(100):
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


def test_scans_without_proposals() -> None:
    rng, samples = np.random.default_rng(0), []
    for number in range(3):
        frame, proposed = proposed_frame(number)
        nothing = SecondStageInputs(Detections.empty(NAMES), proposed.keypoints[:0], proposed.bev[:0])
        samples.append(prepare_sample(frame, proposed if number == 1 else nothing, SETTINGS, 16, rng))
    assert len(refine(small_refiner().eval(), frame.points, nothing, SETTINGS, PostProcess(), "second")) == 0
    assert [len(sample.targets.rois) for sample in samples] == [0, 16, 0]
    inputs, targets = collate_samples(samples)
    assert torch.isfinite(refine_loss(small_refiner()(inputs), targets).total)


def by_equation(gate: ContextGate, features: NDArray[np.float64]) -> NDArray[np.float64]:
    """1 / (1 + exp(-(W_g f + b))) * (W f), channel by channel."""
    of_gate, bias, of_value = (part.detach().numpy() for part in (gate.gate.weight, gate.gate.bias, gate.value.weight))
    gated = np.empty(features.shape)
    for keypoint, feature in enumerate(features):
        for channel in range(len(of_gate)):
            opened = 1 / (1 + np.exp(-(np.dot(of_gate[channel], feature) + bias[channel])))
            gated[keypoint, channel] = opened * np.dot(of_value[channel], feature)
    return gated


def test_a_gate_is_its_equation() -> None:
    torch.manual_seed(0)
    gate, features = ContextGate(5).double(), 3 * torch.randn(7, 5, dtype=torch.float64)
    np.testing.assert_allclose(gate(features).detach().numpy(), by_equation(gate, features.numpy()), rtol=1e-9)


def test_only_the_gated_source_goes_through_its_gate() -> None:
    torch.manual_seed(0)
    sources = [BallSource(1, 2, (6, 4)), BallSource(2, 1, (3,), gated=True), BallSource(3, 1, (2,))]
    encoder = KeypointEncoder(sources, 2, 5, weighting_channels=4).double().eval()
    rows = [SourceRows(torch.randn(9, 3).double(), torch.randn(9, source.channels).double()) for source in sources]
    keypoints, bev = torch.randn(6, 3).double(), torch.randn(6, 2).double()
    indices = [torch.randint(0, 9, (6, 4)) for _ in range(4)]
    with torch.inference_mode():
        found, logits = encoder(rows, keypoints, bev, indices)
        of_source = (0, 0, 1, 2)
        first, second, gated, last = (
            encoder.balls[ball](*rows[source], keypoints, indices[ball]) for ball, source in enumerate(of_source)
        )
        (gate,) = encoder.gates.values()
        assert isinstance(gate, ContextGate)
        gated = torch.from_numpy(by_equation(gate, gated.numpy()))
        joined = torch.cat([first, second, gated, last, bev], dim=1)
        weights = 1 / (1 + torch.exp(-encoder.weigh(joined)))
        torch.testing.assert_close(logits, encoder.weigh(joined)[:, 0])
        torch.testing.assert_close(found, weights * encoder.fuse(joined))
