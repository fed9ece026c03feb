"""The sparse 3D backbone (SECOND; PV-RCNN, section 3.1): convolutions at active voxels alone, by tables."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from asca_pillars.models.map_layers import NORM_EPS, NORM_MOMENTUM
from asca_pillars.models.table_conv import table_conv
from asca_pillars.ops.pv_rcnn.rulebooks import SUBMANIFOLD, VoxelLevel
from asca_pillars.ops.sparse.rulebooks import Convolution

_CONVS = 2  # submanifold convolutions of each level but the last


class TableLayer(nn.Module):
    """A convolution by table, BatchNorm over active cells, ReLU; its weight has the shape of a dense convolution's."""

    def __init__(self, in_channels: int, channels: int, convolution: Convolution) -> None:
        super().__init__()
        self.convolution = nn.Conv3d(in_channels, channels, convolution.kernel, bias=False)
        self.norm = nn.BatchNorm1d(channels, eps=NORM_EPS, momentum=NORM_MOMENTUM)

    def forward(self, features: Tensor, table: Tensor, back: Tensor | None = None) -> Tensor:
        """Unitless (N, in_channels) -> (M, channels), see `table_conv`."""
        return torch.relu(self.norm(table_conv(features, self.convolution.weight, table, back)))


class VoxelBackbone(nn.Module):
    """conv1 to conv4 and conv_out: each level halves the lattice before it.

    Args:
        in_channels: of a voxel.
        channels: output channels of the levels.
        strided: the convolutions that lead from level to level.
    """

    def __init__(self, in_channels: int, channels: Sequence[int], strided: Sequence[Convolution]) -> None:
        super().__init__()
        *inner, out = channels
        self.down = nn.ModuleList(
            TableLayer(before, after, convolution)
            for before, after, convolution in zip(channels[:-1], channels[1:], strided, strict=True)
        )
        reads = [in_channels, *inner[1:]]
        self.same = nn.ModuleList(
            nn.ModuleList(TableLayer(read if number == 0 else width, width, SUBMANIFOLD) for number in range(_CONVS))
            for read, width in zip(reads, inner, strict=True)
        )
        self.out_channels = out

    def forward(self, features: Tensor, levels: Sequence[VoxelLevel[Tensor]]) -> list[Tensor]:
        """Voxel features (N, in_channels) -> unitless features (M, channels) of the active cells of every level."""
        found = []
        for number, level in enumerate(levels):
            if number:
                features = self.down[number - 1](features, level.strided, level.strided_back)
            if number < len(self.same):
                for layer in self.same[number].children():
                    features = layer(features, level.same)
            found.append(features)
        return found
