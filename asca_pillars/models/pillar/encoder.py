"""Feature encoding network: points of pillars -> one feature vector per pillar (section 3.2 of the paper)."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from asca_pillars.config.pillar import CpaReading
from asca_pillars.models.map_backbone import NORM_EPS, NORM_MOMENTUM
from asca_pillars.models.pillar.attention import ChannelAttention, ChannelLinear, PaperAttention, PointAttention
from asca_pillars.models.sparse_conv import linear_rows
from asca_pillars.ops.pillar.prepare import FEATURES, PillarLimits


@torch.library.custom_op("asca::pillar_max", mutates_args=())
def _traced_pillar_max(features: Tensor, pillar_index: Tensor, point_counts: Tensor) -> Tensor:
    return torch.segment_reduce(features, "max", lengths=point_counts, unsafe=True)


@_traced_pillar_max.register_fake
def _(features: Tensor, pillar_index: Tensor, point_counts: Tensor) -> Tensor:
    return features.new_empty(point_counts.shape[0], features.shape[1])


def pillar_max(features: Tensor, pillar_index: Tensor, point_counts: Tensor) -> Tensor:
    """Largest value of each channel among the points of each pillar: unitless features (M, C) -> (P, C).

    Points lie flat, without padding, so nothing but real points can win. While a graph is exported the reduction is
    one named operator, because the exporter knows no segment reduction (asca_export.graphs translates it).
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
            self.register_buffer("empty_slot", torch.zeros(channels))  # what a row of zeros gives
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
        """Point features (M, 9) -> pillar features (P, C), which are unitless.

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
