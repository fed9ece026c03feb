"""The exported forms of set abstraction against the trained one."""

from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

from asca_export.graphs import export_graph
from asca_export.two_stage.graphs import GatheredSetAbstraction, GroupedSetAbstraction
from asca_pillars.models.two_stage.layers import SetAbstraction
from asca_pillars.ops.points.neighbors import BallGroup, GroupedBalls, ball_query, gather_balls, group_balls
from tests.ops.points.clouds import cloud

WIDTHS = [(6,), (6, 5), (6, 5, 7)]
_SIZES = [(3,), (3, 1), (3,), (3, 2), (6,)]  # of the example's balls


def trained(widths: tuple[int, ...]) -> SetAbstraction:
    """With statistics that are not those of fresh weights."""
    torch.manual_seed(0)
    module = SetAbstraction(1, widths).train()
    with torch.no_grad():
        for norm in module.norms:
            assert isinstance(norm, torch.nn.BatchNorm1d)
            norm.weight.uniform_(-1, 1)
            norm.bias.uniform_(-1, 1)
        for _ in range(5):
            module(torch.randn(9, 3), torch.randn(9, 1), torch.randn(8, 3), torch.randint(0, 9, (8, 4)))
    return module.eval()


def balls(radius_m: float = 1.5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """120 points far from the sensor, 60 queries, some of them with an empty ball, and indices."""
    points, queries = cloud(0, 120, 3.0, coarse=False), cloud(1, 60, 3.0, coarse=False)
    indices = ball_query(points, queries, radius_m, 16)
    assert 0 < (indices[:, 0] == len(points)).sum() < len(queries)
    return points, queries[:, :3].copy(), indices


@pytest.mark.parametrize("widths", WIDTHS)
def test_forms(widths: tuple[int, ...]) -> None:
    module, (points, queries, indices) = trained(widths), balls()
    positions, features = torch.from_numpy(points[:, :3]), torch.from_numpy(points[:, 3:])
    grouped = group_balls(indices, len(points))
    groups = GroupedBalls(
        tuple(BallGroup(*map(torch.from_numpy, group)) for group in grouped.groups), torch.from_numpy(grouped.rows)
    )
    with torch.no_grad():
        around = torch.from_numpy(queries)
        expected = module(positions, features, around, torch.from_numpy(indices))
        by_groups = GroupedSetAbstraction(module)(positions, features, around, groups)
        gathered = torch.from_numpy(gather_balls(points, queries, indices))
        by_points = GatheredSetAbstraction(module)(None, None, around, gathered)
    assert expected.std() > 0.1
    torch.testing.assert_close(by_groups, expected, atol=2e-5, rtol=1e-5)
    torch.testing.assert_close(by_points, expected, atol=2e-5, rtol=1e-5)


class _Grouped(torch.nn.Module):
    """Two groups as arguments, as a graph has them."""

    def __init__(self, module: SetAbstraction) -> None:
        super().__init__()
        self.fast = GroupedSetAbstraction(module)

    def forward(self, points: torch.Tensor, queries: torch.Tensor, *balls: torch.Tensor) -> torch.Tensor:
        groups = GroupedBalls((BallGroup(balls[0], balls[1]), BallGroup(balls[2], balls[3])), balls[4])
        found: torch.Tensor = self.fast(points[:, :3], points[:, 3:], queries, groups)
        return found


@pytest.mark.parametrize("radius_m", [1.5, 0.001])
def test_groups_without_balls_in_onnxruntime(radius_m: float, tmp_path: Path) -> None:
    """A scan may leave any group empty."""
    module, (points, queries, _) = trained((6, 5)), balls()
    indices = ball_query(points, queries, radius_m, 2)
    grouped = group_balls(indices, len(points))
    one, two = grouped.groups
    assert (len(two.queries) > 0) == (radius_m > 1)
    given = {
        "points": points,
        "queries": queries,
        "queries_1": one.queries,
        "members_1": one.members,
        "queries_2": two.queries,
        "members_2": two.members,
        "rows": grouped.rows,
    }
    points_rows, queries_rows, first, second = map(torch.export.Dim, ("n", "q", "first", "second"))
    export_graph(
        _Grouped(module),
        [torch.rand(5, 4), torch.rand(6, 3), *(torch.zeros(size, dtype=torch.int32) for size in _SIZES)],
        tmp_path / "grouped.onnx",
        input_names=list(given),
        output_names=["found"],
        dynamic_shapes=(
            *({0: points_rows}, {0: queries_rows}),
            tuple({0: rows} for rows in (first, first, second, second, queries_rows)),
        ),
    )
    session = onnxruntime.InferenceSession(tmp_path / "grouped.onnx", providers=["CPUExecutionProvider"])
    (found,) = session.run(None, given)
    with torch.no_grad():
        expected = module(*map(torch.from_numpy, (points[:, :3], points[:, 3:], queries, indices)))
    np.testing.assert_allclose(found, expected.numpy(), atol=2e-5, rtol=1e-5)
