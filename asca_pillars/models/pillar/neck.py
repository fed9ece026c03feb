"""Detection neck: the region proposal network of Table 1."""

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (torch's own convention)

from asca_pillars.models.map_backbone import convolution_block, joined_maps, upsampling
from asca_pillars.models.sparse_conv import at_active_cells, linear_rows, table_conv
from asca_pillars.ops.pillar.grid import HEAD_STRIDE, NECK_STRIDE
from asca_pillars.ops.pillar.neck_rulebooks import MaskRule, NeckTables


class RPNLayers(nn.Module):
    """Three blocks that halve the map, three deblocks that bring it back to the head's resolution.

    Args:
        in_channels: channels of the pseudo-image.
        block_channels: output channels of Block1..3.
        block_convs: stride-1 convolutions after each block's strided one.
        upsample_channels: output channels of each deblock.
    """

    def __init__(
        self,
        in_channels: int,
        block_channels: Sequence[int],
        block_convs: Sequence[int],
        upsample_channels: int,
    ) -> None:
        super().__init__()
        self.blocks = nn.ModuleList()
        self.deblocks = nn.ModuleList()
        stride = 1
        for channels, convs in zip(block_channels, block_convs, strict=True):
            stride *= 2
            self.blocks.append(convolution_block(in_channels, channels, convs))
            self.deblocks.append(upsampling(channels, upsample_channels, stride // HEAD_STRIDE))
            in_channels = channels
        if stride != NECK_STRIDE:
            raise ValueError(f"{len(block_channels)} blocks end at stride {stride}, the grid is made for {NECK_STRIDE}")
        self.out_channels = upsample_channels * len(self.blocks)


class RPNNeck(RPNLayers):
    """The neck of Table 1, everywhere on the map; its three levels are concatenated."""

    def forward(self, canvas: Tensor) -> Tensor:
        """Unitless (B, C, H, W) -> (B, out_channels, H / 2, W / 2); 384 channels with Table 1's widths."""
        return joined_maps(canvas, self.blocks, self.deblocks)


class SparseRPNNeck(RPNLayers):
    """The same neck, computed at active cells alone; its weights have the names and shapes of `RPNNeck`'s.

    Batch normalization is over active cells. A convolution's missing inputs are zero, and so are the upsampled values
    of a level at head cells where only another level is active.

    Args:
        rule: which cells are active, see `ops.pillar.neck_rulebooks`.
        widths: as for `RPNLayers`.
    """

    def __init__(self, *widths: Any, rule: MaskRule) -> None:
        super().__init__(*widths)
        self.rule: MaskRule = rule
        # A tap's channels lie side by side in memory, as gathered rows do: products read the weights without a copy.
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, pillars: Tensor, tables: NeckTables[Tensor]) -> Tensor:
        """Unitless features of pillars (P, C) -> (M, out_channels) at M active head cells."""
        maps = []
        for block, deblock, level in zip(self.blocks, self.deblocks, tables.levels, strict=True):
            for number, (convolution, norm) in enumerate(block_layers(block)):
                table, back = (
                    (level.strided, level.strided_back),
                    (level.first, level.first_back),
                    (level.same, None),
                )[min(number, 2)]
                pillars = torch.relu(at_active_cells(norm, table_conv(pillars, convolution.weight, table, back)))
            maps.append(_upsampled(deblock, pillars, level.places))
        return torch.cat(maps, dim=1)

    def forward_dense(self, canvas: Tensor, tables: NeckTables[Tensor]) -> Tensor:
        """The same function by dense convolutions with masks: pseudo-image (B, C, ny, nx) -> (M, out_channels)."""
        maps = []
        for block, deblock, level in zip(self.blocks, self.deblocks, tables.levels, strict=True):
            for number, (convolution, norm) in enumerate(block_layers(block)):
                everywhere = convolution(canvas).permute(0, 2, 3, 1)  # (B, h, w, outputs)
                cells = (level.cells if number else level.strided_cells).long()
                active = torch.relu(at_active_cells(norm, everywhere.flatten(0, 2)[cells]))
                masked = active.new_zeros(everywhere.shape).flatten(0, 2).index_put((cells,), active)
                canvas = masked.view(everywhere.shape).permute(0, 3, 1, 2)
            maps.append(_upsampled(deblock, active, level.places))
        return torch.cat(maps, dim=1)


def block_layers(block: nn.Module) -> Iterator[tuple[Any, Any]]:
    """Each convolution of a block, and the normalization that follows it."""
    children = list(block.children())
    return zip(children[0::3], children[1::3], strict=True)


def _upsampled(deblock: nn.Module, features: Tensor, places: Tensor) -> Tensor:
    """A deblock at active parents (N, C), read at head cells: (M, upsample_channels)."""
    transposed, norm, _ = deblock.children()
    assert isinstance(transposed, nn.ConvTranspose2d)
    by_place = transposed.weight.movedim(1, -1).flatten(1).T  # (stride^2 * channels, C)
    outputs = linear_rows(features, by_place).view(-1, transposed.out_channels)
    outputs = torch.relu(at_active_cells(norm, outputs))  # (N * stride^2, channels), one parent after the other
    return F.pad(outputs, (0, 0, 0, 1)).index_select(0, places)
