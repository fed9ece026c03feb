"""Set abstraction (PointNet++): a shared MLP on the points of a ball, and the largest of each channel."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.models.two_stage.point_mlp import NORM_EPS, NORM_MOMENTUM


class SetAbstraction(nn.Module):
    """MLP(3 + C -> widths) on [p_j - q ; f_j] for the points j of the ball around q, then the maximum.

    The first layer is linear, so W [p_j - q ; f_j] = W [p_j ; f_j] - W [q ; 0]: once for each point and once for each
    query instead of once for each pair, exact but for rounding. It must stay in float32, because p_j and q are large
    and their difference is small.

    Args:
        in_channels: C, features of a point; may be 0.
        widths: output channels of the layers, each with BatchNorm and ReLU.
    """

    def __init__(self, in_channels: int, widths: Sequence[int]) -> None:
        super().__init__()
        inputs = [3 + in_channels, *widths[:-1]]
        self.layers = nn.ModuleList(nn.Linear(a, b, bias=False) for a, b in zip(inputs, widths, strict=True))
        self.norms = nn.ModuleList(nn.BatchNorm1d(width, eps=NORM_EPS, momentum=NORM_MOMENTUM) for width in widths)
        self.out_channels = widths[-1]

    def forward(self, positions: Tensor, features: Tensor, queries: Tensor, indices: Tensor) -> Tensor:
        """Features of the queries, (Q, out_channels), see `grouped`."""
        return self.grouped(positions, features, queries, indices).max(dim=1).values

    def grouped(self, positions: Tensor, features: Tensor, queries: Tensor, indices: Tensor) -> Tensor:
        """What the MLP says of each point of each ball, (Q, T, out_channels).

        Args:
            positions: (N, 3) of the points, metres, in the frame of the queries.
            features: (N, C).
            queries: (Q, 3).
            indices: (Q, T) points of each ball, see `ball_query`; N stands for nothing. An empty ball is a row of
                zeros, so its features are MLP(0).
        """
        first: Tensor = self.layers[0].weight  # type: ignore[assignment]  # (widths[0], 3 + C)
        points = F.linear(torch.cat([positions, features], dim=1), first)  # (N, widths[0])
        points = F.pad(points, (0, 0, 0, 1))  # row N
        found = (indices[:, :1] < positions.shape[0]).to(points.dtype)
        centers = F.linear(queries, first[:, :3]) * found  # (Q, widths[0])
        grouped = points.index_select(0, indices.reshape(-1)).unflatten(0, indices.shape) - centers[:, None]
        return self.after_first(grouped.flatten(0, 1)).unflatten(0, indices.shape)

    def after_first(self, pairs: Tensor) -> Tensor:
        """What the first layer gives -> what the last one gives, both (Q * T, channels)."""
        pairs = torch.relu(self.norms[0](pairs))
        for layer, norm in zip(self.layers[1:], self.norms[1:], strict=True):
            pairs = torch.relu(norm(layer(pairs)))
        return pairs


def found_once(indices: Tensor, count: int) -> Tensor:
    """(Q, T) 1 for what `ball_query` found, 0 where it repeats a ball's first member, and for index `count`."""
    again = (indices[:, 1:] != indices[:, :1]) & (indices[:, 1:] < count)
    return torch.cat([indices[:, :1] < count, again], dim=1).float()
