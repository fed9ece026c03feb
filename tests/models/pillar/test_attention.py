"""The readings of CPA: what each may and may not depend on."""

import pytest
import torch
from torch.nn import functional

from asca_pillars.models.pillar.encoder import ChannelAttention, ChannelLinear, PaperAttention, PointAttention

CHANNELS = 8


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(3)


def test_channel_reading_does_not_depend_on_pillar_order() -> None:
    attention = ChannelAttention(CHANNELS)
    features = torch.rand(30, CHANNELS)
    order = torch.randperm(30)
    torch.testing.assert_close(attention(features)[order], attention(features[order]))


def test_channel_reading_does_not_depend_on_pillar_number() -> None:
    # Every pillar twice: the same correlations among channels, so the same answer for each.
    attention = ChannelAttention(CHANNELS)
    features = torch.rand(30, CHANNELS)
    doubled = attention(features.repeat(2, 1))
    torch.testing.assert_close(doubled, attention(features).repeat(2, 1))


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


def test_channel_reading_keeps_its_precision_in_mixed_precision_training() -> None:
    attention = ChannelAttention(CHANNELS)
    features = torch.randn(3000, CHANNELS)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = attention(features)
    torch.testing.assert_close(mixed, attention(features))


def test_the_linear_control_is_channel_attention_whose_mixing_no_frame_changes() -> None:
    control, attention = ChannelLinear(CHANNELS), ChannelAttention(CHANNELS)
    frame, other = torch.randn(30, CHANNELS), torch.randn(20, CHANNELS)
    torch.testing.assert_close(control(frame), frame)  # training starts at the identity
    with torch.no_grad():
        control.restore.weight.copy_(attention.mixing(frame))
        control.restore.bias.copy_(attention.restore.bias)
    torch.testing.assert_close(control(frame), attention(frame))
    assert not torch.allclose(control(other), attention(other), atol=1e-4)
    torch.testing.assert_close(control(torch.cat([frame, other]))[30:], control(other))
    with torch.autocast("cpu", torch.bfloat16):
        mixed = control(frame)
    torch.testing.assert_close(mixed, control(frame))


def test_channel_reading_of_silent_channels_is_finite() -> None:
    attention = ChannelAttention(CHANNELS)
    features = torch.zeros(30, CHANNELS, requires_grad=True)
    output = attention(features)
    output.sum().backward()
    assert output.isfinite().all() and features.grad is not None and features.grad.isfinite().all()


def test_channel_reading_mixes_channels() -> None:
    attention = ChannelAttention(CHANNELS)
    features = torch.rand(30, CHANNELS)
    changed = features.clone()
    changed[0, 0] += 1
    difference = (attention(changed) - attention(features)).abs()
    assert difference[0].min() > 0 and difference[1:].max() > 0


def test_paper_reading_of_few_pillars_equals_zero_padding_to_all() -> None:
    attention = PaperAttention(CHANNELS, max_pillars=20, width=6)
    features = torch.rand(7, CHANNELS)
    padded = torch.cat([features, torch.zeros(13, CHANNELS)])
    torch.testing.assert_close(attention(features), attention(padded)[:7])


def test_paper_reading_is_equations_6_to_11() -> None:
    attention = PaperAttention(CHANNELS, max_pillars=20, width=6)
    matrix = torch.rand(20, CHANNELS).T  # F of the paper, C x P
    query = matrix @ attention.query + attention.bias["query"]
    key = matrix @ attention.key + attention.bias["key"]
    value = matrix @ attention.value + attention.bias["value"]
    weights = torch.softmax(query @ key.T / 6**0.5, dim=1)
    expected = (weights @ value) @ attention.restore + attention.bias["restore"] + matrix
    torch.testing.assert_close(attention(matrix.T), expected.T)


def test_paper_reading_depends_on_pillar_order() -> None:
    # What the other readings avoid, and the reason why they exist.
    attention = PaperAttention(CHANNELS, max_pillars=20)
    features = torch.rand(20, CHANNELS)
    order = torch.arange(19, -1, -1)
    assert (attention(features)[order] - attention(features[order])).abs().max() > 1e-3


def _points() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    point_counts = torch.tensor([3, 1, 5])
    return torch.rand(9, CHANNELS), torch.arange(3).repeat_interleave(point_counts), point_counts


def test_point_reading_looks_at_the_own_pillar_only() -> None:
    attention = PointAttention(CHANNELS, max_points=6)
    features, pillar_index, point_counts = _points()
    changed = features.clone()
    changed[3] += 1  # the only point of pillar 1
    difference = (
        attention(changed, pillar_index, point_counts) - attention(features, pillar_index, point_counts)
    ).abs()
    assert difference[3].max() > 0
    assert difference[pillar_index != 1].max() == 0


def test_point_reading_does_not_depend_on_point_order() -> None:
    attention = PointAttention(CHANNELS, max_points=6)
    features, pillar_index, point_counts = _points()
    order = torch.tensor([2, 0, 1, 3, 8, 7, 6, 5, 4])  # within pillars
    found = attention(features[order], pillar_index, point_counts)
    torch.testing.assert_close(found, attention(features, pillar_index, point_counts)[order])


def test_point_reading_does_not_see_its_padding() -> None:
    features, pillar_index, point_counts = _points()
    tight, loose = PointAttention(CHANNELS, max_points=5), PointAttention(CHANNELS, max_points=64)
    loose.load_state_dict(tight.state_dict())
    torch.testing.assert_close(tight(features, pillar_index, point_counts), loose(features, pillar_index, point_counts))


def test_point_reading_equals_attention_pillar_by_pillar() -> None:
    attention = PointAttention(CHANNELS, max_points=6)
    features, pillar_index, point_counts = _points()
    expected = []
    for pillar in features.split(point_counts.tolist()):
        query, key, value = attention.query(pillar), attention.key(pillar), attention.value(pillar)
        attended = torch.softmax(query @ key.T / CHANNELS**0.5, dim=1) @ value
        expected.append(pillar + attention.restore(attended))
    torch.testing.assert_close(attention(features, pillar_index, point_counts), torch.cat(expected))
