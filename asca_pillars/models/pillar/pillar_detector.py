"""The whole network: pillarize and decode stand in `geometry`, the five stops between them here."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.utils._pytree import tree_map_only

from asca_pillars.config import Config
from asca_pillars.geometry.decode import HeadMaps
from asca_pillars.models.pillar.encoder import PillarEncoder
from asca_pillars.models.pillar.head import SSDHead
from asca_pillars.models.pillar.neck import RPNNeck, SparseRPNNeck
from asca_pillars.pillars.grid import PillarGrid
from asca_pillars.pillars.pillarize import Pillars
from asca_pillars.tables.neck_tables import NeckTableBuilder, NeckTables, stack_neck_tables


class PillarBatch(NamedTuple):
    """Pillars of B frames, one frame's after the other's.

    Attributes:
        features: (M, 9) decorated points.
        pillar_index: (M,) pillar of each point, counted through the batch, ascending.
        point_counts: (P,) points of each pillar.
        cells: (P,) flat index (row * nx + column) of each pillar in its own frame.
        frame_pillars: pillars of each frame.
        neck: what a sparse neck reads; None for the dense one.
    """

    features: Tensor
    pillar_index: Tensor
    point_counts: Tensor
    cells: Tensor
    frame_pillars: Sequence[int]
    neck: NeckTables[Tensor] | None = None

    def to(self, device: Any) -> "PillarBatch":
        """The batch on another device."""
        moved: PillarBatch = tree_map_only(Tensor, lambda tensor: tensor.to(device), self)
        return moved


class PillarDetector(nn.Module):
    """ASCA-PointPillars (figure 1 of the paper); PointPillars with K = 1, V_max = 0.16 m and no CPA."""

    def __init__(self, grid: PillarGrid, encode: PillarEncoder, neck: RPNNeck | SparseRPNNeck, head: SSDHead) -> None:
        super().__init__()
        self.grid = grid
        self.encode = encode
        self.neck = neck
        self.head = head

    def forward(self, batch: PillarBatch) -> HeadMaps[Tensor]:
        """Pillars of B frames -> head maps, or rows of the active head cells of a sparse neck, see `SSDHead`."""
        pillar_features = self.encode(
            batch.features, batch.pillar_index, batch.point_counts, batch.frame_pillars
        )  # (P, C)
        if batch.neck is not None and not pillar_features.is_cuda:
            return self.head.at_cells(self.neck(pillar_features, batch.neck))
        canvas = self.scatter(pillar_features, batch.cells, batch.frame_pillars)  # (B, C, ny, nx)
        if batch.neck is not None:  # where a dense convolution costs less than gathering
            assert isinstance(self.neck, SparseRPNNeck)
            return self.head.at_cells(self.neck.forward_dense(canvas, batch.neck))
        maps: HeadMaps[Tensor] = self.head(self.neck(canvas))
        return maps

    def neck_tables(self, pillars: Pillars) -> NeckTables[NDArray[np.int32]] | None:
        """What this network's neck reads of a scan besides the features; None for the dense neck."""
        if not isinstance(self.neck, SparseRPNNeck):
            return None
        return NeckTableBuilder(self.grid.ny, self.grid.nx, self.neck.rule).build(pillars.cells)

    def scatter(self, pillar_features: Tensor, cells: Tensor, frame_pillars: Sequence[int]) -> Tensor:
        """Put each pillar's features at its cell of an empty pseudo-image: (P, C) -> (B, C, ny, nx)."""
        ny, nx = self.grid.ny, self.grid.nx
        frames, channels = len(frame_pillars), pillar_features.shape[1]
        frame_starts = cells.new_tensor([frame * ny * nx for frame in range(frames)])
        row = cells + frame_starts.repeat_interleave(cells.new_tensor(frame_pillars))
        # Channels last in memory: a pillar is one contiguous row here, and convolutions on a CPU prefer it.
        canvas = pillar_features.new_zeros(frames * ny * nx, channels).index_put((row,), pillar_features)
        return canvas.view(frames, ny, nx, channels).permute(0, 3, 1, 2)


def batch_pillars(
    frames: Sequence[Pillars], tables: Sequence[NeckTables[NDArray[np.int32]] | None] = ()
) -> PillarBatch:
    """Pillars of several frames, one frame's after the other's, and the tables of each for a sparse neck."""
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
        neck=_stack_tables([each for each in tables if each is not None], frame_pillars),
    )


def _stack_tables(
    tables: Sequence[NeckTables[NDArray[np.int32]]], frame_pillars: Sequence[int]
) -> NeckTables[Tensor] | None:
    if not tables:
        return None
    stacked: NeckTables[Tensor] = tree_map_only(np.ndarray, torch.from_numpy, stack_neck_tables(tables, frame_pillars))
    return stacked


def frame_maps(maps: HeadMaps[Tensor], batch: PillarBatch) -> Iterator[tuple[HeadMaps[NDArray[np.float32]], Any]]:
    """Of each frame its maps and None, or its rows and their head cells (M,), as `decode` takes them."""
    parts = [part.float().cpu().numpy() for part in maps]
    if batch.neck is None:
        for frame in range(len(batch.frame_pillars)):
            yield HeadMaps(*(part[frame] for part in parts)), None
        return
    cells, map_cells, first = batch.neck.head_cells.cpu().numpy(), math.prod(batch.neck.map_shape), 0
    for frame, rows in enumerate(batch.neck.frame_rows):
        own = slice(first, first + rows)
        yield HeadMaps(*(part[own] for part in parts)), cells[own] - frame * map_cells
        first += rows


def build_detector(config: Config) -> PillarDetector:
    """The network that `config` describes, with fresh random weights."""
    network, spec = config.network, config.detector
    widths = network.pillar_channels, network.block_channels, network.block_convs, network.upsample_channels
    neck: RPNNeck | SparseRPNNeck
    neck = RPNNeck(*widths) if network.neck == "dense" else SparseRPNNeck(*widths, rule=network.active_cells)
    return PillarDetector(
        grid=spec.grid,
        encode=PillarEncoder(network.pillar_channels, network.cpa, spec.limits),
        neck=neck,
        head=SSDHead(neck.out_channels, anchors_per_cell=spec.anchors.shape[2]),
    )
