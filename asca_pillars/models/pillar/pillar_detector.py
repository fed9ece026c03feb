"""The whole network: pillarize and decode stand in `geometry`, the five stops between them here."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from asca_pillars.config import PillarModel
from asca_pillars.geometry.decode import HeadMaps
from asca_pillars.models.pillar.encoder import PillarEncoder
from asca_pillars.models.pillar.head import SSDHead
from asca_pillars.models.pillar.neck import RPNNeck
from asca_pillars.pillars.grid import PillarGrid
from asca_pillars.pillars.pillarize import Pillars


class PillarBatch(NamedTuple):
    """Pillars of B frames, one frame's after the other's.

    Attributes:
        features: (M, 9) decorated points.
        pillar_index: (M,) pillar of each point, counted through the batch, ascending.
        point_counts: (P,) points of each pillar.
        cells: (P,) flat index (row * nx + column) of each pillar in its own frame.
        frame_pillars: pillars of each frame.
    """

    features: Tensor
    pillar_index: Tensor
    point_counts: Tensor
    cells: Tensor
    frame_pillars: Sequence[int]


class PillarDetector(nn.Module):
    """ASCA-PointPillars (figure 1 of the paper); PointPillars with K = 1, V_max = 0.16 m and no CPA."""

    def __init__(self, grid: PillarGrid, encode: PillarEncoder, neck: RPNNeck, head: SSDHead) -> None:
        super().__init__()
        self.grid = grid
        self.encode = encode
        self.neck = neck
        self.head = head

    def forward(self, batch: PillarBatch) -> HeadMaps[Tensor]:
        """Pillars of B frames -> head maps, see `SSDHead`."""
        pillar_features = self.encode(
            batch.features, batch.pillar_index, batch.point_counts, batch.frame_pillars
        )  # (P, C)
        canvas = self.scatter(pillar_features, batch.cells, batch.frame_pillars)  # (B, C, ny, nx)
        maps: HeadMaps[Tensor] = self.head(self.neck(canvas))
        return maps

    def scatter(self, pillar_features: Tensor, cells: Tensor, frame_pillars: Sequence[int]) -> Tensor:
        """Put each pillar's features at its cell of an empty pseudo-image: (P, C) -> (B, C, ny, nx)."""
        ny, nx = self.grid.ny, self.grid.nx
        frames, channels = len(frame_pillars), pillar_features.shape[1]
        frame_starts = cells.new_tensor([frame * ny * nx for frame in range(frames)])
        row = cells + frame_starts.repeat_interleave(cells.new_tensor(frame_pillars))
        # Channels last in memory: a pillar is one contiguous row here, and convolutions on a CPU prefer it.
        canvas = pillar_features.new_zeros(frames * ny * nx, channels).index_put((row,), pillar_features)
        return canvas.view(frames, ny, nx, channels).permute(0, 3, 1, 2)


def batch_pillars(frames: Sequence[Pillars]) -> PillarBatch:
    """Pillars of several frames, one frame's after the other's."""
    frame_pillars = [len(frame.cells) for frame in frames]
    starts = np.concatenate([[0], np.cumsum(frame_pillars)[:-1]]).astype(np.int64)
    return PillarBatch(
        features=torch.from_numpy(np.concatenate([frame.features for frame in frames])),
        pillar_index=torch.from_numpy(
            np.concatenate([frame.pillar_index + start for frame, start in zip(frames, starts, strict=True)])
        ),
        point_counts=torch.from_numpy(np.concatenate([frame.point_counts for frame in frames])),
        cells=torch.from_numpy(np.concatenate([frame.cells for frame in frames])),
        frame_pillars=frame_pillars,
    )


def build_pillar_detector(model: PillarModel) -> PillarDetector:
    """The network that `model` describes, with fresh random weights."""
    network, spec = model.network, model.spec
    neck = RPNNeck(network.pillar_channels, network.block_channels, network.block_convs, network.upsample_channels)
    return PillarDetector(
        grid=spec.grid,
        encode=PillarEncoder(network.pillar_channels, network.cpa, spec.limits),
        neck=neck,
        head=SSDHead(neck.out_channels, anchors_per_cell=spec.anchors.shape[2]),
    )
