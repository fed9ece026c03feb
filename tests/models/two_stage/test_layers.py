"""Set abstraction, whose first layer is split, and VectorPool against the equations as printed."""

import copy
from typing import TypeAlias

import numpy as np
import pytest
import torch
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.models.two_stage.layers import SetAbstraction, VectorPool
from asca_pillars.ops.points.neighbors import nearest_in_cubes

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


HALF_M = 0.8


def scene(channels: int = 4) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """30 points, their features, 6 queries and the neighbors of their cells; the last two have two points and none."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-1.5, 1.5, (28, 3)), [[50, 0, 0], [50.5, 0.2, 0]]])
    queries = np.concatenate([rng.uniform(-1, 1, (4, 3)), [[50.1, 0, 0], [90, 0, 0]]])
    queries[0] = points[0]  # the middle cell's center is a point
    return points, rng.normal(size=(30, channels)), queries, nearest_in_cubes(points, queries, HALF_M, 3)


def pool_by_hand(
    pool: VectorPool, points: np.ndarray, features: np.ndarray, query: np.ndarray, rows: np.ndarray
) -> np.ndarray:
    """Eq. (13) to (15) for one query in evaluation mode, after the printed form: W_t on what is interpolated."""
    channels, of_cells = pool.places.shape[2], []
    kernels = pool.features.weight.detach().numpy().reshape(27, channels, -1)
    for cell, (center, of_cell) in enumerate(zip(pool.centers.double().numpy(), rows, strict=True)):
        near = [i for i in of_cell if i < len(points)]
        away = np.zeros((3, 3))
        away[: len(near)] = points[near] - (query + center)
        interpolated = np.zeros(features.shape[1])
        if near:
            weights = 1 / np.maximum(np.linalg.norm(away[: len(near)], axis=1), 1e-8)
            interpolated = weights @ features[near] / weights.sum()
        of_cells.append(away.reshape(-1) @ pool.places[cell].detach().numpy() + kernels[cell] @ interpolated)
    value = torch.from_numpy(np.concatenate(of_cells))[None]
    with torch.inference_mode():
        return pool.mlp(torch.relu(pool.norm(value)))[0].numpy()


def random_pool(channels: int = 4) -> VectorPool:
    torch.manual_seed(0)
    pool = VectorPool(channels, HALF_M, 3, 5, (8, 7)).double().eval()
    for name, value in pool.named_buffers():
        if name.endswith("running_mean"):
            torch.nn.init.uniform_(value, -0.5, 0.2)
        elif name.endswith("running_var"):
            torch.nn.init.uniform_(value, 0.3, 1.0)
    return pool


def test_vector_pool_is_what_the_equations_say() -> None:
    pool, (points, features, queries, rows) = random_pool(), scene()
    with torch.inference_mode():
        found = pool(*(torch.from_numpy(part) for part in (points, features, queries, rows))).numpy()
    assert found.shape == (6, 7) and (rows[-1] == 30).all() and (rows[-2, :, 2] == 30).all()
    for query, own, one in zip(queries, rows, found, strict=True):
        np.testing.assert_allclose(one, pool_by_hand(pool, points, features, query, own), atol=1e-9)
    assert np.abs(found[0] - found[1]).max() > 1e-3


def test_no_points_and_no_queries() -> None:
    for module, indices in ((SetAbstraction(4, (7,)).eval(), (2,)), (random_pool().float(), (27, 3))):
        nothing = torch.zeros(3, *indices, dtype=torch.int32)
        assert module(torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(3, 3), nothing).shape == (3, 7)
        assert module(torch.zeros(2, 3), torch.zeros(2, 4), torch.zeros(0, 3), nothing[:0]).shape == (0, 7)
