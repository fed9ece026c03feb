"""Detection neck: the region proposal network of Table 1."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from asca_pillars.models.pillar.encoder import NORM_EPS, NORM_MOMENTUM
from asca_pillars.pillars.grid import HEAD_STRIDE, NECK_STRIDE


class RPNNeck(nn.Module):
    """Three blocks that halve the map, three deblocks that bring it back to the head's resolution, concatenated.

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
            self.blocks.append(_block(in_channels, channels, convs))
            self.deblocks.append(_deblock(channels, upsample_channels, stride // HEAD_STRIDE))
            in_channels = channels
        if stride != NECK_STRIDE:
            raise ValueError(f"{len(block_channels)} blocks end at stride {stride}, the grid is made for {NECK_STRIDE}")
        self.out_channels = upsample_channels * len(self.blocks)

    def forward(self, canvas: Tensor) -> Tensor:
        """Unitless (B, C, H, W) -> (B, out_channels, H / 2, W / 2); 384 channels with Table 1's widths."""
        maps = []
        for block, deblock in zip(self.blocks, self.deblocks, strict=True):
            canvas = block(canvas)
            maps.append(deblock(canvas))
        return torch.cat(maps, dim=1)


def _block(in_channels: int, channels: int, convs: int) -> nn.Sequential:
    # Table 1 prints padding 0 for some strided convolutions and yet halves the maps exactly: one pixel of zeros is
    # what both need.
    layers = _normed(nn.Conv2d(in_channels, channels, 3, stride=2, padding=1, bias=False), channels)
    for _ in range(convs):
        layers += _normed(nn.Conv2d(channels, channels, 3, padding=1, bias=False), channels)
    return nn.Sequential(*layers)


def _deblock(in_channels: int, channels: int, stride: int) -> nn.Sequential:
    return nn.Sequential(
        *_normed(nn.ConvTranspose2d(in_channels, channels, stride, stride=stride, bias=False), channels)
    )


def _normed(convolution: nn.Module, channels: int) -> list[nn.Module]:
    return [
        convolution,
        nn.BatchNorm2d(channels, eps=NORM_EPS, momentum=NORM_MOMENTUM),
        nn.ReLU(inplace=True),
    ]
