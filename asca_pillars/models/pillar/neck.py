"""Detection neck: the region proposal network of Table 1."""

import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.models.map_backbone import MapBackbone, at_active_cells, linear_rows, rulebook_conv
from asca_pillars.ops.pillar.grid import HEAD_STRIDE, NECK_STRIDE
from asca_pillars.ops.pillar.neck_rulebooks import MaskRule, NeckRulebooks

_STRIDES = (2, 2, 2)
assert math.prod(_STRIDES) == NECK_STRIDE, "what the grid is made for"


class RPNNeck(MapBackbone):
    """Dense neck of Table 1: three blocks that halve the map, 384 channels with Table 1's widths."""

    def __init__(self, *widths: Any) -> None:
        super().__init__(*widths, strides=_STRIDES, head_stride=HEAD_STRIDE)


class SparseRPNNeck(MapBackbone):
    """`RPNNeck` computed at active cells only; its weights have the same names and shapes.

    Batch normalization is over active cells. A convolution's missing inputs are zero, and so are the upsampled values
    of a level at head cells where only another level is active.

    Args:
        rule: which cells are active, see `ops.pillar.neck_rulebooks`.
        widths: the first arguments of `MapBackbone`.
    """

    def __init__(self, *widths: Any, rule: MaskRule) -> None:
        super().__init__(*widths, strides=_STRIDES, head_stride=HEAD_STRIDE)
        self.rule: MaskRule = rule
        # A tap's channels lie side by side in memory, as gathered rows do: products read the weights without a copy.
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, pillars: Tensor, rulebooks: NeckRulebooks[Tensor]) -> Tensor:  # type: ignore[override]
        """Apply the neck: features of pillars (P, C) -> (M, out_channels) at M active head cells."""
        maps = []
        for block, deblock, level in zip(self.blocks, self.deblocks, rulebooks.levels, strict=True):
            for number, (convolution, norm) in enumerate(block_layers(block)):
                rulebook, back = (
                    (level.strided, level.strided_back),
                    (level.first, level.first_back),
                    (level.same, None),
                )[min(number, 2)]
                pillars = torch.relu(at_active_cells(norm, rulebook_conv(pillars, convolution.weight, rulebook, back)))
            maps.append(_upsampled(deblock, pillars, level.places))
        return torch.cat(maps, dim=1)


def block_layers(block: nn.Module) -> Iterator[tuple[Any, Any]]:
    """Return each convolution of a block with the normalization that follows it."""
    children = list(block.children())
    return zip(children[0::3], children[1::3], strict=True)


def _upsampled(deblock: nn.Module, features: Tensor, places: Tensor) -> Tensor:
    """Apply a deblock at active parents (N, C), and read it at head cells: (M, upsample_channels)."""
    transposed, norm, _ = deblock.children()
    assert isinstance(transposed, nn.ConvTranspose2d)
    by_place = transposed.weight.movedim(1, -1).flatten(1).T  # (stride^2 * channels, C)
    outputs = linear_rows(features, by_place).view(-1, transposed.out_channels)
    outputs = torch.relu(at_active_cells(norm, outputs))  # (N * stride^2, channels), one parent after the other
    return F.pad(outputs, (0, 0, 0, 1)).index_select(0, places)
