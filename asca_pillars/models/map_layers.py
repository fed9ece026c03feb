"""Layers of a backbone on a map seen from above (SECOND, PointPillars): blocks, and their upsamplings."""

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor, nn

NORM_EPS, NORM_MOMENTUM = 1e-3, 0.01  # as in SECOND and PointPillars


def as_map(cells: Tensor) -> Tensor:
    """A map whose channels lie side by side, as convolutions read it: (B, H, W, C) -> (B, C, H, W).

    They lie so in memory after it, too, which suits convolutions; but on a CPU without AVX-512 their gradients then
    take twice the time, and the map is copied.
    """
    maps = cells.permute(0, 3, 1, 2)
    if cells.device.type == "cpu" and torch.backends.cpu.get_cpu_capability() == "AVX2":
        return maps.contiguous()
    return maps


def convolution_block(in_channels: int, channels: int, convs: int, *, stride: int = 2) -> nn.Sequential:
    """A 3x3 convolution with this stride and `convs` with stride 1, each with BatchNorm and ReLU.

    Table 1 of ASCA-PointPillars prints padding 0 for some strided convolutions and yet halves the maps exactly: one
    pixel of zeros is what both need.
    """
    layers = _normed(nn.Conv2d(in_channels, channels, 3, stride=stride, padding=1, bias=False), channels)
    for _ in range(convs):
        layers += _normed(nn.Conv2d(channels, channels, 3, padding=1, bias=False), channels)
    return nn.Sequential(*layers)


def upsampling(in_channels: int, channels: int, stride: int) -> nn.Sequential:
    """A transposed convolution whose kernel is its stride, with BatchNorm and ReLU."""
    return nn.Sequential(
        *_normed(nn.ConvTranspose2d(in_channels, channels, stride, stride=stride, bias=False), channels)
    )


def joined_maps(
    features: Tensor,
    blocks: Sequence[nn.Module] | nn.ModuleList,
    deblocks: Iterable[nn.Module],
    attention: Iterable[nn.Module] | None = None,
) -> Tensor:
    """Block after block, each upsampled, side by side: (B, C, H, W) -> (B, channels of all, H', W').

    With `attention` a module after each block, before its upsampling and the next block.
    """
    maps = []
    for block, attend, deblock in zip(blocks, attention or [nn.Identity()] * len(blocks), deblocks, strict=True):
        features = attend(block(features))
        maps.append(deblock(features))
    return torch.cat(maps, dim=1)


def _normed(convolution: nn.Module, channels: int) -> list[nn.Module]:
    return [
        convolution,
        nn.BatchNorm2d(channels, eps=NORM_EPS, momentum=NORM_MOMENTUM),
        nn.ReLU(inplace=True),
    ]
