"""Pillar encoder: shapes, and that nothing but a frame's own points can change its pillars."""

import pytest
import torch

from asca_pillars.config.pillar import CpaReading
from asca_pillars.models.pillar.encoder import PillarEncoder, pillar_max
from asca_pillars.ops.pillar.prepare import PillarLimits

LIMITS = PillarLimits(max_pillars=40, max_points=6)
READINGS = ("none", "paper", "channel", "point", "linear")


def _frame(pillars: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    point_counts = torch.randint(1, LIMITS.max_points + 1, (pillars,))
    return (
        torch.randn(int(point_counts.sum()), 9),
        torch.arange(pillars).repeat_interleave(point_counts),
        point_counts,
    )


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(5)


def test_pillar_max_equals_a_loop() -> None:
    features, pillar_index, point_counts = _frame(20)
    expected = torch.stack([features[pillar_index == pillar].max(dim=0).values for pillar in range(20)])
    assert torch.equal(pillar_max(features, pillar_index, point_counts), expected)


def test_pillar_max_of_negative_features_is_not_lifted_to_zero() -> None:
    assert pillar_max(torch.tensor([[-2.0], [-1.0]]), torch.tensor([0, 0]), torch.tensor([2])).item() == -1


@pytest.mark.parametrize("cpa", READINGS)
def test_a_batch_is_its_frames(cpa: CpaReading) -> None:
    encoder = PillarEncoder(16, cpa, LIMITS).eval()
    first, second = _frame(12), _frame(30)
    together = encoder(
        torch.cat([first[0], second[0]]),
        torch.cat([first[1], second[1] + 12]),
        torch.cat([first[2], second[2]]),
        frame_pillars=[12, 30],
    )
    assert together.shape == (42, 16)
    torch.testing.assert_close(together, torch.cat([encoder(*first), encoder(*second)]), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("cpa", READINGS)
def test_point_order_within_a_pillar_does_not_matter(cpa: CpaReading) -> None:
    encoder = PillarEncoder(16, cpa, LIMITS).eval()
    features, pillar_index, point_counts = _frame(12)
    order = torch.cat([torch.flip(rows, (0,)) for rows in torch.arange(len(features)).split(point_counts.tolist())])
    torch.testing.assert_close(
        encoder(features[order], pillar_index, point_counts), encoder(features, pillar_index, point_counts)
    )


@pytest.mark.parametrize("cpa", READINGS)
def test_gradient_reaches_every_parameter(cpa: CpaReading) -> None:
    encoder = PillarEncoder(16, cpa, LIMITS)
    encoder(*_frame(40)).square().sum().backward()
    for name, parameter in encoder.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


def test_parameter_counts() -> None:
    def count(cpa: CpaReading) -> int:
        return sum(int(p.numel()) for p in PillarEncoder(64, cpa, PillarLimits()).parameters())

    pfn = 9 * 64 + 2 * 64  # linear without bias, scale and shift of the normalization
    assert count("none") == pfn
    assert count("channel") == pfn + 4 * 64 * 64 + 64 + 1  # query, key, value, restore with bias, temperature
    assert count("linear") == pfn + 64 * 64 + 64
    assert count("point") == pfn + 4 * 64 * 64 + 64
    # Q, K, V: 12000 -> 64 with bias; restore: 64 -> 12000 with bias
    assert count("paper") == pfn + 3 * (12000 * 64 + 64) + 64 * 12000 + 12000
