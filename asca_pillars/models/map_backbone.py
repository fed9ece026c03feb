"""Layers on a bird's-eye-view map (SECOND, PointPillars): blocks, their upsamplings, and the head on them."""

import math
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor, nn

from asca_pillars.detection.decode import HeadMaps
from asca_pillars.models.sparse_conv import linear_rows

NORM_EPS, NORM_MOMENTUM = 1e-3, 0.01  # as in SECOND and PointPillars


def as_map(cells: Tensor) -> Tensor:
    """Permute a channels-last map for convolutions: (B, H, W, C) -> (B, C, H, W).

    They lie so in memory after it, too, which suits convolutions; but on a CPU without AVX-512 their gradients then
    take twice the time, and the map is copied.
    """
    maps = cells.permute(0, 3, 1, 2)
    if cells.device.type == "cpu" and torch.backends.cpu.get_cpu_capability() == "AVX2":
        return maps.contiguous()
    return maps


def convolution_block(in_channels: int, channels: int, convs: int, *, stride: int = 2) -> nn.Sequential:
    """Build a 3x3 convolution with this stride and `convs` with stride 1, each with BatchNorm and ReLU.

    Table 1 of ASCA-PointPillars prints padding 0 for some strided convolutions and yet halves the maps exactly: one
    pixel of zeros is what both need.
    """
    layers = _normed(nn.Conv2d(in_channels, channels, 3, stride=stride, padding=1, bias=False), channels)
    for _ in range(convs):
        layers += _normed(nn.Conv2d(channels, channels, 3, padding=1, bias=False), channels)
    return nn.Sequential(*layers)


def upsampling(in_channels: int, channels: int, stride: int) -> nn.Sequential:
    """Build a transposed convolution whose kernel is its stride, with BatchNorm and ReLU."""
    return nn.Sequential(
        *_normed(nn.ConvTranspose2d(in_channels, channels, stride, stride=stride, bias=False), channels)
    )


class MapBackbone(nn.Module):
    """Blocks on a map, each upsampled to the head's resolution and concatenated (SECOND, PointPillars, PV-RCNN).

    Args:
        in_channels: of the map.
        block_channels: output channels of each block.
        block_convs: stride-1 convolutions after each block's first one.
        upsample_channels: output channels of each upsampling.
        strides: of each block's first convolution.
        head_stride: of the head's map.
        attention: a module after each block, before its upsampling and the next block; None for none.
    """

    def __init__(
        self,
        in_channels: int,
        block_channels: Sequence[int],
        block_convs: Sequence[int],
        upsample_channels: int,
        *,
        strides: Sequence[int],
        head_stride: int = 1,
        attention: Iterable[nn.Module] | None = None,
    ) -> None:
        super().__init__()
        self.blocks, self.deblocks, stride = nn.ModuleList(), nn.ModuleList(), 1
        self.attention = None if attention is None else nn.ModuleList(attention)
        for channels, convs, step in zip(block_channels, block_convs, strides, strict=True):
            stride *= step
            self.blocks.append(convolution_block(in_channels, channels, convs, stride=step))
            self.deblocks.append(upsampling(channels, upsample_channels, stride // head_stride))
            in_channels = channels
        self.out_channels = upsample_channels * len(self.blocks)

    def forward(self, canvas: Tensor) -> Tensor:
        """Apply the blocks: unitless (B, C, H, W) -> (B, out_channels, h, w), with h, w = H, W / head_stride."""
        maps, attention = [], self.attention or [nn.Identity()] * len(self.blocks)
        for block, attend, deblock in zip(self.blocks, attention, self.deblocks, strict=True):
            canvas = attend(block(canvas))
            maps.append(deblock(canvas))
        return torch.cat(maps, dim=1)


def _normed(convolution: nn.Module, channels: int) -> list[nn.Module]:
    return [
        convolution,
        nn.BatchNorm2d(channels, eps=NORM_EPS, momentum=NORM_MOMENTUM),
        nn.ReLU(inplace=True),
    ]


POSITIVE_PRIOR = 0.01  # initial score of every anchor, which stabilizes focal loss (arXiv 1708.02002, 4.1)


class SSDHead(nn.Module):
    """Class logit, seven box residuals and two direction logits for each of A anchors per cell.

    An anchor belongs to one class and is only ever matched with that class, so it carries one class logit;
    `scores_per_anchor` is for the head of SECOND and PV-RCNN, whose every anchor has a logit for each class.
    """

    def __init__(self, in_channels: int, anchors_per_cell: int, scores_per_anchor: int = 1) -> None:
        super().__init__()
        self.scores = nn.Conv2d(in_channels, anchors_per_cell * scores_per_anchor, 1)
        self.boxes = nn.Conv2d(in_channels, anchors_per_cell * 7, 1)
        self.directions = nn.Conv2d(in_channels, anchors_per_cell * 2, 1)
        nn.init.constant_(self.scores.bias, -math.log((1 - POSITIVE_PRIOR) / POSITIVE_PRIOR))  # type: ignore[arg-type]
        nn.init.normal_(self.boxes.weight, std=0.001)

    def forward(self, features: Tensor) -> HeadMaps[Tensor]:
        """Apply the head: (B, C, H, W) -> scores (B, A, H, W), boxes (B, 7A, H, W), directions (B, 2A, H, W).

        With several scores per anchor there are so many times A of them, those of an anchor side by side.
        """
        return HeadMaps(self.scores(features), self.boxes(features), self.directions(features))

    def at_cells(self, features: Tensor) -> HeadMaps[Tensor]:
        """Apply the head at single cells: (M, C) -> scores (M, A), boxes (M, 7A), directions (M, 2A)."""
        joined = linear_rows(features, *self.joined())  # one product and one gradient of the features instead of three
        return HeadMaps(*joined.split(self.channels, dim=1))

    @property
    def channels(self) -> list[int]:
        """Output channels of scores, boxes and directions."""
        return [part.out_channels for part in (self.scores, self.boxes, self.directions)]

    def joined(self) -> tuple[Tensor, Tensor]:
        """Return the convolutions as one product: weight (outputs, C) and bias (outputs,), split by `channels`."""
        parts = self.scores, self.boxes, self.directions
        weight = torch.cat([part.weight[:, :, 0, 0] for part in parts])
        return weight, torch.cat([part.bias for part in parts if part.bias is not None])
