"""Feature encoding network: points of pillars -> one feature vector per pillar (section 3.2 of the paper).

Correlative point attention (CPA, eq. 6-11) is implemented in the variants that the paper's text allows. Letters: P
pillars of one frame, M points, C channels, d attention width, N points of one pillar at most. Each variant ends with
the residual connection of eq. (11), and so does the control without attention.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.config.pillar import CpaReading
from asca_pillars.models.map_backbone import NORM_EPS, NORM_MOMENTUM, linear_rows
from asca_pillars.ops.pillar.prepare import FEATURES, PillarLimits


class PaperAttention(nn.Module):
    """Eq. (6)-(11) as printed: the MLPs mix the *pillar* axis, attention runs among the C channels.

    The matrices are laid out for `max_pillars` pillars in flat-index order. A frame with fewer uses the first rows
    and columns, which is exactly what zero-padding the frame to `max_pillars` would compute.
    """

    def __init__(self, channels: int, max_pillars: int, width: int = 64) -> None:
        super().__init__()
        bound = max_pillars**-0.5
        self.scale = width**-0.5
        self.query = nn.Parameter(torch.empty(max_pillars, width).uniform_(-bound, bound))
        self.key = nn.Parameter(torch.empty(max_pillars, width).uniform_(-bound, bound))
        self.value = nn.Parameter(torch.empty(max_pillars, channels).uniform_(-bound, bound))
        self.bias = nn.ParameterDict(
            {
                "query": nn.Parameter(torch.zeros(width)),
                "key": nn.Parameter(torch.zeros(width)),
                "value": nn.Parameter(torch.zeros(channels)),
                "restore": nn.Parameter(torch.zeros(max_pillars)),
            }
        )
        bound = channels**-0.5
        self.restore = nn.Parameter(torch.empty(channels, max_pillars).uniform_(-bound, bound))

    def forward(self, features: Tensor) -> Tensor:
        """Apply the attention: features (P, C) -> (P, C) for the pillars of one frame, P <= max_pillars."""
        pillars = features.shape[0]
        by_channel = features.T  # F of the paper, (C, P)
        query = by_channel @ self.query[:pillars] + self.bias["query"]  # (C, d)
        key = by_channel @ self.key[:pillars] + self.bias["key"]  # (C, d)
        value = by_channel @ self.value[:pillars] + self.bias["value"]  # (C, C)
        attention = torch.softmax(query @ key.T * self.scale, dim=-1) @ value  # A, (C, C)
        restored = attention @ self.restore[:, :pillars] + self.bias["restore"][:pillars]  # F', (C, P)
        return features + restored.T


class _ChannelMixing(nn.Module, ABC):
    """Features mixed by a C x C matrix and added to themselves; `restore` has the bias."""

    restore: nn.Linear

    @abstractmethod
    def mixing(self, features: Tensor) -> Tensor:
        """Return the mixing matrix (C, C) of the pillars (P, C) of one frame."""

    def forward(self, features: Tensor) -> Tensor:
        """Apply the attention: features (P, C) -> (P, C) for the pillars of one frame."""
        device = features.device.type
        if torch.is_autocast_enabled(device):  # differences of large sums: bfloat16 would leave little of them
            with torch.autocast(device, enabled=False):
                return self(features.float())
        mixing = self.mixing(features)
        residual = torch.eye(len(mixing), device=mixing.device)  # as part of the product it takes no pass of its own
        return F.linear(features, mixing + residual, self.restore.bias)


class ChannelLinear(_ChannelMixing):
    """Control without attention: a learned C x C mixing matrix that is the same for every frame.

    It separates the effect of attention from that of one more linear layer. Training starts at the identity, near the
    start of channel attention.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.restore = nn.Linear(channels, channels)
        nn.init.zeros_(self.restore.weight)
        nn.init.zeros_(self.restore.bias)

    def mixing(self, features: Tensor) -> Tensor:
        """Return the mixing matrix (C, C), which does not depend on the features (P, C)."""
        return self.restore.weight


class ChannelAttention(_ChannelMixing):
    """Channel attention (C x C) with projections per pillar, which depends on neither order nor number of pillars.

    Queries and keys are normalised along the pillars (cross-covariance attention, XCiT, arXiv 2106.09681), which
    keeps the logits' scale the same for a frame of ten pillars and one of ten thousand.

    Every product of queries and keys is one of pairs of channels summed over the pillars, so the channels' Gram matrix
    suffices for the attention, and the projections act on it instead of on P pillars: two products with the pillars
    where the textbook form has six.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.query = nn.Linear(channels, channels, bias=False)
        self.key = nn.Linear(channels, channels, bias=False)
        self.value = nn.Linear(channels, channels, bias=False)
        self.restore = nn.Linear(channels, channels)
        self.temperature = nn.Parameter(torch.ones(1))

    def mixing(self, features: Tensor) -> Tensor:
        """Return the mixing matrix (C, C) of the pillars (P, C) of one frame."""
        gram = features.T @ features  # (C, C)
        query, key = self.query.weight, self.key.weight
        products = query @ gram @ key.T  # products of queries and keys, summed over the pillars
        query_norm = _norm((query @ gram * query).sum(dim=1))
        key_norm = _norm((key @ gram * key).sum(dim=1))
        logits = products / (query_norm[:, None] * key_norm[None, :]) * self.temperature
        attention = torch.softmax(logits, dim=-1)  # (C, C)
        return self.restore.weight @ attention @ self.value.weight


def _norm(squared: Tensor) -> Tensor:
    return torch.sqrt(squared.clamp_min(1e-24))  # rounding may leave less than nothing


class PointAttention(nn.Module):
    """Self-attention among the points of one pillar, before the max: "associations among points within a pillar"."""

    def __init__(self, channels: int, max_points: int) -> None:
        super().__init__()
        self.max_points = max_points
        self.scale = channels**-0.5
        self.query = nn.Linear(channels, channels, bias=False)
        self.key = nn.Linear(channels, channels, bias=False)
        self.value = nn.Linear(channels, channels, bias=False)
        self.restore = nn.Linear(channels, channels)

    def forward(self, features: Tensor, pillar_index: Tensor, point_counts: Tensor) -> Tensor:
        """Apply the attention: (M, C) point features -> (M, C); points attend to the points of their own pillar only.

        Args:
            features: (M, C), rows of one pillar adjacent.
            pillar_index: (M,) index of each row's pillar, ascending.
            point_counts: (P,) rows of each pillar.
        """
        pillars, channels = point_counts.shape[0], features.shape[1]
        starts = torch.cumsum(point_counts, 0) - point_counts
        rows = torch.arange(features.shape[0], device=features.device)
        slot = pillar_index * self.max_points + rows - starts[pillar_index]  # row of the padded (P * N) table

        def padded(flat: Tensor) -> Tensor:
            table = flat.new_zeros(pillars * self.max_points, channels)
            return table.index_put((slot,), flat).view(pillars, self.max_points, channels)

        query, key, value = (padded(layer(features)) for layer in (self.query, self.key, self.value))
        empty = torch.arange(self.max_points, device=features.device) >= point_counts[:, None]  # (P, N)
        logits = (query @ key.transpose(1, 2) * self.scale).masked_fill(empty[:, None, :], float("-inf"))
        attended = (torch.softmax(logits, dim=-1) @ value).view(-1, channels)[slot]  # back to (M, C)
        return features + self.restore(attended)


@torch.library.custom_op("asca::pillar_max", mutates_args=())
def _traced_pillar_max(features: Tensor, pillar_index: Tensor, point_counts: Tensor) -> Tensor:
    return torch.segment_reduce(features, "max", lengths=point_counts, unsafe=True)


@_traced_pillar_max.register_fake
def _(features: Tensor, pillar_index: Tensor, point_counts: Tensor) -> Tensor:
    return features.new_empty(point_counts.shape[0], features.shape[1])


def pillar_max(features: Tensor, pillar_index: Tensor, point_counts: Tensor) -> Tensor:
    """Return the channel-wise maximum over the points of each pillar: features (M, C) -> (P, C).

    Points lie flat, without padding, so only real points are compared. While a graph is exported the reduction is
    one named operator, because the exporter has no segment reduction (asca_export.graphs translates it).
    """
    if torch.compiler.is_exporting():
        pooled: Tensor = _traced_pillar_max(features, pillar_index, point_counts)
        return pooled
    return torch.segment_reduce(features, "max", lengths=point_counts, unsafe=True)


class PillarEncoder(nn.Module):
    """PFN and CPA: Linear(9 -> C), BatchNorm, ReLU, max over the points of a pillar, attention.

    Args:
        channels: C, features of one pillar.
        cpa: reading of the attention; `point` acts before the max, the others after it.
        limits: caps on pillars and points, which the `paper` and `point` readings lay their tables out for.
        empty_slots: whether a pillar with fewer points than fit also has `empty_slot` among them, before its
            normalization.
    """

    empty_slot: Tensor

    def __init__(self, channels: int, cpa: CpaReading, limits: PillarLimits, *, empty_slots: bool = False) -> None:
        super().__init__()
        self.slots = limits.max_points if empty_slots else 0
        if empty_slots:
            self.register_buffer("empty_slot", torch.zeros(channels))  # output for a row of zeros
        self.linear = nn.Linear(len(FEATURES), channels, bias=False)
        self.norm = nn.BatchNorm1d(channels, eps=NORM_EPS, momentum=NORM_MOMENTUM)
        self.point_attention = PointAttention(channels, limits.max_points) if cpa == "point" else None
        self.pillar_attention: nn.Module | None = None
        if cpa == "paper":
            self.pillar_attention = PaperAttention(channels, limits.max_pillars)
        elif cpa == "channel":
            self.pillar_attention = ChannelAttention(channels)
        elif cpa == "linear":
            self.pillar_attention = ChannelLinear(channels)

    def forward(
        self,
        features: Tensor,
        pillar_index: Tensor,
        point_counts: Tensor,
        frame_pillars: Sequence[int] | None = None,
    ) -> Tensor:
        """Point features (M, 9) -> pillar features (P, C).

        Args:
            features: (M, 9) decorated points, see `ops.pillar.prepare.FEATURES`.
            pillar_index: (M,) index of each point's pillar, ascending.
            point_counts: (P,) points of each pillar.
            frame_pillars: pillars of each frame of a batch, summing to P; None is one frame.
        """
        points = linear_rows(features, self.linear.weight)  # (M, C)
        if self.slots:
            points = torch.cat([points, self.empty_slot[None]])
        points = torch.relu(self.norm(points))
        if self.slots:
            points, empty = points[:-1], points[-1:]
        if self.point_attention is not None:
            points = self.point_attention(points, pillar_index, point_counts)
        pillars = pillar_max(points, pillar_index, point_counts)  # (P, C)
        if self.slots:
            pillars = torch.where((point_counts < self.slots)[:, None], torch.maximum(pillars, empty), pillars)
        if self.pillar_attention is None:
            return pillars
        if frame_pillars is None:
            attended: Tensor = self.pillar_attention(pillars)
            return attended
        return torch.cat([self.pillar_attention(frame) for frame in pillars.split(list(frame_pillars))])
