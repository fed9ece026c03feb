"""Pillar encoder and the readings of CPA against their equations; nothing but a frame's own points changes it."""

import pytest
import torch
from torch.nn import functional

from asca_pillars.config.pillar import CpaReading
from asca_pillars.models.pillar.encoder import (
    ChannelAttention,
    ChannelLinear,
    PaperAttention,
    PillarEncoder,
    PointAttention,
    pillar_max,
)
from asca_pillars.ops.pillar.prepare import PillarLimits

LIMITS = PillarLimits(max_pillars=40, max_points=6)
READINGS = ("none", "paper", "channel", "point", "linear")
CHANNELS = 8


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(5)


def _frame(pillars: int, channels: int = 9) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Features of points, their pillars, and how many points each has."""
    point_counts = torch.randint(1, LIMITS.max_points + 1, (pillars,))
    index = torch.arange(pillars).repeat_interleave(point_counts)
    return torch.randn(len(index), channels), index, point_counts


def test_pillar_max_equals_a_loop() -> None:
    features, pillar_index, point_counts = _frame(20)
    expected = torch.stack([features[pillar_index == pillar].max(dim=0).values for pillar in range(20)])
    assert torch.equal(pillar_max(features, pillar_index, point_counts), expected)


@pytest.mark.parametrize("cpa", READINGS)
def test_a_batch_is_its_frames(cpa: CpaReading) -> None:
    encoder = PillarEncoder(16, cpa, LIMITS).eval()
    first, second = _frame(12), _frame(30)
    joined = zip(first, (second[0], second[1] + 12, second[2]), strict=True)
    together = encoder(*(torch.cat(parts) for parts in joined), frame_pillars=[12, 30])
    assert together.shape == (42, 16)
    torch.testing.assert_close(together, torch.cat([encoder(*first), encoder(*second)]), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("cpa", READINGS)
def test_gradient_reaches_every_parameter(cpa: CpaReading) -> None:
    encoder = PillarEncoder(16, cpa, LIMITS)
    encoder(*_frame(40)).square().sum().backward()
    for name, parameter in encoder.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


@pytest.mark.parametrize(
    ("cpa", "attention"),
    [
        ("none", 0),
        ("channel", 4 * 64 * 64 + 64 + 1),  # query, key, value, restore with bias, temperature
        ("linear", 64 * 64 + 64),
        ("point", 4 * 64 * 64 + 64),
        ("paper", 3 * (12000 * 64 + 64) + 64 * 12000 + 12000),  # Q, K, V: 12000 -> 64; restore: 64 -> 12000
    ],
)
def test_parameter_counts(cpa: CpaReading, attention: int) -> None:
    pfn = 9 * 64 + 2 * 64  # linear without bias, scale and shift of the normalization
    encoder = PillarEncoder(64, cpa, PillarLimits())
    assert sum(weights.numel() for weights in encoder.parameters()) == pfn + attention


def test_channel_reading_is_cross_covariance_attention() -> None:
    attention = ChannelAttention(CHANNELS)
    with torch.no_grad():
        attention.temperature.fill_(3.0)
    features = torch.randn(30, CHANNELS)
    query = functional.normalize(attention.query(features), dim=0)
    key = functional.normalize(attention.key(features), dim=0)
    weights = torch.softmax(query.T @ key * attention.temperature, dim=-1)
    expected = features + attention.restore(attention.value(features) @ weights.T)
    torch.testing.assert_close(attention(features), expected)
    silent = torch.zeros(30, CHANNELS, requires_grad=True)
    (output := attention(silent)).sum().backward()
    assert output.isfinite().all() and silent.grad is not None and silent.grad.isfinite().all()


def test_the_linear_control_is_channel_attention_whose_mixing_no_frame_changes() -> None:
    control, attention = ChannelLinear(CHANNELS), ChannelAttention(CHANNELS)
    frame, other = torch.randn(30, CHANNELS), torch.randn(20, CHANNELS)
    torch.testing.assert_close(control(frame), frame)  # training starts at the identity
    with torch.no_grad():
        control.restore.weight.copy_(attention.mixing(frame))
        control.restore.bias.copy_(attention.restore.bias)
    torch.testing.assert_close(control(frame), attention(frame))
    torch.testing.assert_close(control(torch.cat([frame, other]))[30:], control(other))


@pytest.mark.parametrize("reading", [ChannelAttention, ChannelLinear])
def test_mixing_keeps_its_precision_in_mixed_precision_training(
    reading: type[ChannelAttention | ChannelLinear],
) -> None:
    attention, features = reading(CHANNELS), torch.randn(3000, CHANNELS)
    torch.nn.init.normal_(attention.restore.weight)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = attention(features)
    torch.testing.assert_close(mixed, attention(features))


def test_paper_reading_is_equations_6_to_11() -> None:
    attention = PaperAttention(CHANNELS, max_pillars=20, width=6)
    matrix = torch.rand(20, CHANNELS).T  # F of the paper, C x P
    query = matrix @ attention.query + attention.bias["query"]
    key = matrix @ attention.key + attention.bias["key"]
    value = matrix @ attention.value + attention.bias["value"]
    weights = torch.softmax(query @ key.T / 6**0.5, dim=1)
    expected = (weights @ value) @ attention.restore + attention.bias["restore"] + matrix
    torch.testing.assert_close(attention(matrix.T), expected.T)
    padded = torch.cat([matrix.T[:7], torch.zeros(13, CHANNELS)])  # few pillars are zeros up to all
    torch.testing.assert_close(attention(matrix.T[:7]), attention(padded)[:7])


def test_point_reading_equals_attention_pillar_by_pillar() -> None:
    attention = PointAttention(CHANNELS, max_points=LIMITS.max_points)
    features, pillar_index, point_counts = _frame(12, CHANNELS)
    assert 1 in point_counts and LIMITS.max_points in point_counts
    expected = []
    for pillar in features.split(point_counts.tolist()):
        query, key, value = attention.query(pillar), attention.key(pillar), attention.value(pillar)
        attended = torch.softmax(query @ key.T / CHANNELS**0.5, dim=1) @ value
        expected.append(pillar + attention.restore(attended))
    torch.testing.assert_close(attention(features, pillar_index, point_counts), torch.cat(expected))
