"""Set abstraction in the forms that run fastest: of balls that the host has gathered, or grouped by their points.

Both end alike. A shift and a ReLU keep the order of values, so after the last layer they follow the maximum: once for
each ball instead of once for each of its points, with the same result.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (torch's own convention)
from torch.nn.utils.fusion import fuse_linear_bn_eval

from asca_pillars.models.two_stage.set_abstraction import SetAbstraction
from asca_pillars.ops.points.ball_layouts import GroupedBalls


class _Layers(nn.Module):
    """The layers of a trained `SetAbstraction` with their normalization in them; it stays as it is."""

    def __init__(self, trained: SetAbstraction) -> None:
        super().__init__()
        layers = [_folded(*pair) for pair in zip(trained.layers, trained.norms, strict=True)]
        self.layers = nn.ModuleList(layers)
        self.first, self.last = layers[0], layers[-1]
        self.out_channels = trained.out_channels

    def after_first(self, pairs: Tensor) -> Tensor:
        """What the first layer gives -> what the last one gives before its shift, both (pairs, channels)."""
        for layer in self.layers[1:-1]:
            pairs = layer(torch.relu(pairs))
        return torch.relu(pairs) @ self.last.weight.T if len(self.layers) > 1 else pairs

    def first_shift(self) -> Tensor | None:
        """None if it is the last one's."""
        return self.first.bias if len(self.layers) > 1 else None


class GatheredSetAbstraction(_Layers):
    """Of balls whose points have been gathered. Points have fewer channels than the first layer gives."""

    def forward(self, _positions: None, _features: None, _queries: Tensor, balls: Tensor) -> Tensor:
        """[p_j - q ; f_j] of each ball, (Q, T, 3 + C), zeros for nothing -> (Q, out_channels)."""
        pairs = F.linear(balls.flatten(0, 1), self.first.weight, self.first_shift())
        largest = self.after_first(pairs).unflatten(0, balls.shape[:2]).amax(dim=1)
        return torch.relu(largest + self.last.bias)


class GroupedSetAbstraction(_Layers):
    """For balls in groups (`ops.points.ball_layouts`): the first layer runs once for each point and each query."""

    def forward(self, positions: Tensor, features: Tensor, queries: Tensor, balls: GroupedBalls[Tensor]) -> Tensor:
        """As `SetAbstraction.forward`: (Q, out_channels)."""
        # Both get a row for nothing: zeros, and the first layer's shift alone.
        points = F.pad(torch.cat([positions, features], dim=1), (0, 0, 0, 1)) @ self.first.weight.T
        away = F.linear(F.pad(queries, (0, 0, 0, 1)), -self.first.weight[:, :3], self.first_shift())
        largest = []
        for group in balls.groups:
            queries_of_pairs = group.queries[:, None].expand(group.members.shape)  # adding row by row takes longer
            pairs = points.index_select(0, group.members.flatten()) + away.index_select(0, queries_of_pairs.flatten())
            largest.append(self.after_first(pairs).unflatten(0, group.members.shape).amax(dim=1))
        return torch.relu(torch.cat(largest).index_select(0, balls.rows) + self.last.bias)


def _folded(layer: nn.Module, norm: nn.Module) -> nn.Linear:
    assert isinstance(layer, nn.Linear) and isinstance(norm, nn.BatchNorm1d)
    return fuse_linear_bn_eval(layer, norm)
