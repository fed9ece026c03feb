"""Network from pillars to head maps, with its training interface (`models.trainable.Trainable`)."""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from typing import NamedTuple

import torch
from torch import Tensor, nn

from asca_pillars.config.pillar import LossConfig, PillarModel
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.models.map_backbone import SSDHead, as_map
from asca_pillars.models.pillar.encoder import PillarEncoder, pillar_max
from asca_pillars.models.pillar.loss import detection_loss, targets_at
from asca_pillars.models.pillar.neck import RPNNeck, SparseRPNNeck
from asca_pillars.models.pillar.preparation import LabeledPillars, PillarBatch, PillarPreparation
from asca_pillars.models.trainable import Trainable
from asca_pillars.ops.pillar.neck_rulebooks import NeckRulebooks
from asca_pillars.ops.pillar.spec import PillarSpec


class PillarOutputs(NamedTuple):
    """Outputs of the network for B frames.

    Attributes:
        maps: head maps, or rows of the active head cells of a sparse neck, see `SSDHead`.
        neck: the rulebooks with the indices of these cells; None for maps.
    """

    maps: HeadMaps[Tensor]
    neck: NeckRulebooks[Tensor] | None


class PillarDetector(Trainable):
    """ASCA-PointPillars (figure 1 of the paper); PointPillars with K = 1, V_max = 0.16 m and no CPA.

    Args:
        spec: grid, limits and classes that its parts were made for.
        loss_weights: weights of the loss terms.
        encode: points of pillars to pillar features (section 3.2).
        neck: pseudo-image, or pillars and rulebooks, to features (section 3.3).
        head: features to head maps.
    """

    preparation: PillarPreparation

    def __init__(
        self,
        spec: PillarSpec,
        loss_weights: LossConfig,
        encode: PillarEncoder,
        neck: RPNNeck | SparseRPNNeck,
        head: SSDHead,
    ) -> None:
        super().__init__()
        self.grid = spec.grid
        rule = neck.rule if isinstance(neck, SparseRPNNeck) else None
        self.preparation = PillarPreparation(spec, rule, loss_weights.assigner)
        self.loss_weights = loss_weights
        self.encode = encode
        self.neck = neck
        self.head = head

    def forward(self, batch: PillarBatch) -> HeadMaps[Tensor]:
        """Apply the network: pillars of B frames -> head maps (B, channels, H, W) of logits and residuals.

        With a sparse neck: rows (M, channels) of the active head cells, see `SSDHead`.

        Raises:
            ValueError: the batch was made without the placements of `self.preparation`, which this detector needs.
        """
        return self.read_head(self.head_input(batch), batch)

    def head_input(self, batch: PillarBatch) -> Tensor:
        """Return the neck's output: (B, C, H, W), with a sparse neck (M, C) at active head cells."""
        pillar_features = self.encode(
            batch.features, batch.pillar_index, batch.point_counts, batch.frame_pillars
        )  # (P, C)
        features, cells, frame_cells = self.pool(pillar_features, batch)
        if batch.neck is not None:
            return self.neck(features, batch.neck)  # type: ignore[no-any-return]
        canvas = self.scatter(features, cells, frame_cells)  # (B, C, rows, columns)
        return self.neck(canvas)  # type: ignore[no-any-return]

    def read_head(self, features: Tensor, batch: PillarBatch) -> HeadMaps[Tensor]:
        """Apply the head to the result of `head_input` for that batch: maps, or rows of them, see `forward`."""
        if batch.neck is not None:
            return self.head.at_cells(features)
        maps: HeadMaps[Tensor] = self.head(features)
        return maps

    def predict(self, batch: LabeledPillars) -> PillarOutputs:
        """Return head maps (B, channels, H, W) of logits and residuals of B labelled frames, and their cells.

        Where a normalization would see a single point or cell, its running statistics are used.
        """
        pillars, neck = batch.pillars, batch.pillars.neck
        rows = [len(pillars.features)]
        if neck is not None:
            rows += [len(cells) for level in neck.levels for cells in (level.strided_cells, level.cells)]
        with _running_statistics(self) if self.training and 1 in rows else nullcontext():
            return PillarOutputs(self(pillars), neck)

    def loss(self, outputs: PillarOutputs, batch: LabeledPillars) -> Mapping[str, Tensor]:
        """Return the terms of eq. (15) by name, from head maps (B, channels, H, W), see `detection_loss`.

        Anchors at inactive head cells are left out.
        """
        neck, targets = outputs.neck, batch.targets
        seen = targets if neck is None else targets_at(targets, neck.head_cells)
        return detection_loss(outputs.maps, seen, self.loss_weights)._asdict()

    def detect(self, outputs: PillarOutputs, spec: DetectorSpec) -> list[Detections]:
        """Return boxes in head maps (B, channels, H, W) for each frame, LiDAR frame, with the thresholds of `spec`."""
        arrays = [part.float().cpu().numpy() for part in outputs.maps]
        neck = outputs.neck
        if neck is None:
            return [spec.decode(HeadMaps(*frame)) for frame in zip(*arrays, strict=True)]
        cells, map_cells, first, detections = neck.head_cells.cpu().numpy(), math.prod(neck.map_shape), 0, []
        for frame, rows in enumerate(neck.frame_rows):
            frame_slice = slice(first, first + rows)
            maps = HeadMaps(*(part[frame_slice] for part in arrays))
            detections.append(spec.decode(maps, cells[frame_slice] - frame * map_cells))
            first += rows
        return detections

    def pool(self, pillar_features: Tensor, batch: PillarBatch) -> tuple[Tensor, Tensor, Sequence[int]]:
        """Pool pillar features (P, C) -> features (M, C) and cells (M,) of the map, and their number in each frame.

        See `ops.pillar.grid`; without a pooled map pillars and cells are the same.
        """
        if self.grid.pools != (batch.pooling is not None) or isinstance(self.neck, RPNNeck) != (batch.neck is None):
            raise ValueError("the batch was placed for another map or neck; use `preparation.place` of this detector")
        if batch.pooling is None:
            return pillar_features, batch.cells, batch.frame_pillars
        cells, pillars, counts = batch.pooling
        cell_index = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
        return pillar_max(pillar_features[pillars], cell_index, counts), cells, batch.frame_cells

    def scatter(self, features: Tensor, cells: Tensor, frame_cells: Sequence[int]) -> Tensor:
        """Put features at their cells of an empty pseudo-image: (M, C) -> (B, C, rows, columns)."""
        rows, columns = self.grid.map_shape
        frames, channels = len(frame_cells), features.shape[1]
        frame_starts = cells.new_tensor([frame * rows * columns for frame in range(frames)])
        row = cells + frame_starts.repeat_interleave(cells.new_tensor(frame_cells))
        canvas = features.new_zeros(frames * rows * columns, channels).index_put((row,), features)
        return as_map(canvas.view(frames, rows, columns, channels))


@contextmanager
def _running_statistics(module: nn.Module) -> Iterator[None]:
    """Normalize by running statistics within the block, because a single value per channel has no variance.

    `SyncBatchNorm` is not changed: other devices wait for it, and its statistics include theirs.
    """
    norms = [part for part in module.modules() if isinstance(part, nn.BatchNorm1d | nn.BatchNorm2d)]
    training = [norm for norm in norms if norm.training]
    for norm in training:
        norm.eval()
    try:
        yield
    finally:
        for norm in training:
            norm.train()


def build_pillar_detector(model: PillarModel) -> PillarDetector:
    """Build the network that `model` describes, with fresh random weights."""
    network, spec = model.network, model.spec
    widths = network.pillar_channels, network.block_channels, network.block_convs, network.upsample_channels
    neck: RPNNeck | SparseRPNNeck
    neck = RPNNeck(*widths) if network.neck == "dense" else SparseRPNNeck(*widths, rule=network.active_cells)
    return PillarDetector(
        spec=spec,
        loss_weights=model.loss,
        encode=PillarEncoder(network.pillar_channels, network.cpa, spec.limits, empty_slots=network.empty_slots),
        neck=neck,
        head=SSDHead(neck.out_channels, spec.anchors.shape[2], spec.scores_per_anchor),
    )
