"""The split first layer against the equation as printed."""

import copy

import pytest
import torch

from asca_pillars.models.refine.set_abstraction import SetAbstraction


def balls(dtype: torch.dtype, channels: int = 2, offset_m: float = 0.0) -> tuple[torch.Tensor, ...]:
    """12 points, 5 queries, and 4 indices of each; the second query has an empty ball."""
    generator = torch.Generator().manual_seed(3)
    positions = torch.randn(12, 3, generator=generator, dtype=dtype) + offset_m
    features = torch.randn(12, channels, generator=generator, dtype=dtype)
    queries = torch.randn(5, 3, generator=generator, dtype=dtype) + offset_m
    indices = torch.randint(0, 12, (5, 4), generator=generator, dtype=torch.int32)
    indices[1] = 12
    return positions, features, queries, indices


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("channels", [0, 2])
def test_split_is_naive(training: bool, channels: int) -> None:
    torch.manual_seed(0)
    split = SetAbstraction(channels, (6, 5)).double().train(training)
    naive = copy.deepcopy(split)
    arguments = balls(torch.float64, channels)
    torch.testing.assert_close(split(*arguments), naive.naive(*arguments))
    # Batch statistics and gradients, too.
    for module, output in ((split, split(*arguments)), (naive, naive.naive(*arguments))):
        output.square().sum().backward()
        assert module.layers[0].weight.grad.abs().sum() > 0
    torch.testing.assert_close(split.layers[0].weight.grad, naive.layers[0].weight.grad)
    torch.testing.assert_close(split.norms[0].running_mean, naive.norms[0].running_mean)


def test_float32_far_from_the_sensor() -> None:
    torch.manual_seed(0)
    module = SetAbstraction(2, (6, 5)).eval()
    arguments = balls(torch.float32, offset_m=80.0)
    exact = copy.deepcopy(module).double().naive(*(part.double() for part in arguments[:3]), arguments[3])
    torch.testing.assert_close(module(*arguments).double(), exact, atol=5e-5, rtol=0)


def test_an_empty_ball_is_the_mlp_of_zero_wherever_it_is() -> None:
    torch.manual_seed(0)
    module = SetAbstraction(2, (6, 5)).eval()
    torch.nn.init.normal_(module.norms[0].bias)
    positions, features, queries, indices = balls(torch.float32)
    zero = module._after_first(torch.zeros(1, 6))[0]
    for moved in (queries, queries + 50):
        torch.testing.assert_close(module(positions, features, moved, indices)[1], zero)


def test_gradients() -> None:
    torch.manual_seed(0)
    module = SetAbstraction(2, (3, 2)).double().eval()
    positions, features, queries, indices = balls(torch.float64)
    inputs = [part.requires_grad_() for part in (positions, features, queries)]
    assert torch.autograd.gradcheck(lambda p, f, q: module(p, f, q, indices), inputs)


def test_no_points_and_no_queries() -> None:
    module = SetAbstraction(1, (4,)).eval()
    nothing = torch.zeros(3, 2, dtype=torch.int32)
    assert module(torch.zeros(0, 3), torch.zeros(0, 1), torch.zeros(3, 3), nothing).shape == (3, 4)
    assert module(torch.zeros(2, 3), torch.zeros(2, 1), torch.zeros(0, 3), nothing[:0]).shape == (0, 4)
