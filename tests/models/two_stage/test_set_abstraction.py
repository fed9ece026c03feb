"""The split first layer against the equation as printed."""

import copy
from typing import TypeAlias

import pytest
import torch
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.models.two_stage.sets import SetAbstraction

Balls: TypeAlias = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


def balls(dtype: torch.dtype, channels: int = 2, offset_m: float = 0.0) -> Balls:
    """12 points, 5 queries, and 4 indices of each; the second query has an empty ball."""
    generator = torch.Generator().manual_seed(3)
    positions = torch.randn(12, 3, generator=generator, dtype=dtype) + offset_m
    features = torch.randn(12, channels, generator=generator, dtype=dtype)
    queries = torch.randn(5, 3, generator=generator, dtype=dtype) + offset_m
    indices = torch.randint(0, 12, (5, 4), generator=generator, dtype=torch.int32)
    indices[1] = 12
    return positions, features, queries, indices


def as_printed(module: SetAbstraction, arguments: Balls) -> torch.Tensor:
    """`forward` as the equation is printed: the first layer once for each pair."""
    positions, features, queries, indices = arguments
    rows = F.pad(torch.cat([positions, features], dim=1), (0, 0, 0, 1))
    grouped = rows[indices]  # (Q, T, 3 + C)
    found = (indices < positions.shape[0]).to(rows.dtype)[..., None]
    relative = (grouped[..., :3] - queries[:, None]) * found
    pairs = torch.cat([relative, grouped[..., 3:]], dim=2).flatten(0, 1)
    return module.after_first(module.layers[0](pairs)).unflatten(0, indices.shape).max(dim=1).values


def first_gradient(module: SetAbstraction) -> torch.Tensor:
    """Of the first layer's weight."""
    layer = module.layers[0]
    assert isinstance(layer, torch.nn.Linear) and layer.weight.grad is not None
    return layer.weight.grad


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("channels", [0, 2])
def test_split_is_naive(training: bool, channels: int) -> None:
    torch.manual_seed(0)
    split = SetAbstraction(channels, (6, 5)).double().train(training)
    naive = copy.deepcopy(split)
    arguments = balls(torch.float64, channels)
    torch.testing.assert_close(split(*arguments), as_printed(naive, arguments))
    # Batch statistics and gradients, too.
    for module, output in ((split, split(*arguments)), (naive, as_printed(naive, arguments))):
        output.square().sum().backward()
        assert first_gradient(module).abs().sum() > 0
    torch.testing.assert_close(first_gradient(split), first_gradient(naive))
    torch.testing.assert_close(split.norms[0].running_mean, naive.norms[0].running_mean)


def test_float32_far_from_the_sensor() -> None:
    torch.manual_seed(0)
    module = SetAbstraction(2, (6, 5)).eval()
    arguments = balls(torch.float32, offset_m=80.0)
    positions, features, queries, indices = arguments
    doubles = positions.double(), features.double(), queries.double(), indices
    exact = as_printed(copy.deepcopy(module).double(), doubles)
    torch.testing.assert_close(module(*arguments).double(), exact, atol=5e-5, rtol=0)


def test_an_empty_ball_is_the_mlp_of_zero_wherever_it_is() -> None:
    torch.manual_seed(0)
    module = SetAbstraction(2, (6, 5)).eval()
    norm = module.norms[0]
    assert isinstance(norm, torch.nn.BatchNorm1d)
    torch.nn.init.normal_(norm.bias)
    positions, features, queries, indices = balls(torch.float32)
    zero = module.after_first(torch.zeros(1, 6))[0]
    for moved in (queries, queries + 50):
        torch.testing.assert_close(module(positions, features, moved, indices)[1], zero)


def test_no_points_and_no_queries() -> None:
    module = SetAbstraction(1, (4,)).eval()
    nothing = torch.zeros(3, 2, dtype=torch.int32)
    assert module(torch.zeros(0, 3), torch.zeros(0, 1), torch.zeros(3, 3), nothing).shape == (3, 4)
    assert module(torch.zeros(2, 3), torch.zeros(2, 1), torch.zeros(0, 3), nothing[:0]).shape == (0, 4)
