"""Frames to pillars and targets, and batches of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils._pytree import tree_map_only

from asca_pillars.data.frames import LabeledFrame, within_ranges
from asca_pillars.detection.targets import Assigner, Targets, assign_targets
from asca_pillars.models.pillar.loss import TargetBatch
from asca_pillars.ops.pillar.grid import MapCells, map_cells
from asca_pillars.ops.pillar.neck_rulebooks import MaskRule, NeckRulebookBuilder, NeckRulebooks, stack_neck_rulebooks
from asca_pillars.ops.pillar.prepare import Pillars
from asca_pillars.ops.pillar.spec import PillarSpec


class Placement(NamedTuple):
    """Positions of a frame's pillars on the map, as the neck takes them.

    Attributes:
        pooling: of a pooled map; None where pillars and cells are the same.
        rulebooks: of a sparse neck; None for a dense one.
    """

    pooling: MapCells[NDArray[np.int64]] | None
    rulebooks: NeckRulebooks[NDArray[np.int32]] | None


class TargetedPillars(NamedTuple):
    """One frame: its pillars, their positions on the map, and the targets of its anchors."""

    pillars: Pillars
    placement: Placement
    targets: Targets


class PillarBatch(NamedTuple):
    """Pillars of B frames, one frame's after the other's.

    Attributes:
        features: (M, 9) decorated points.
        pillar_index: (M,) pillar of each point, counted through the batch, ascending.
        point_counts: (P,) points of each pillar.
        cells: (P,) flat index (row * nx + column) of each pillar in its own frame.
        frame_pillars: pillars of each frame.
        neck: what a sparse neck reads; None for the dense one.
        pooling: cells of a pooled map (in their own frame) and their pillars (counted through the batch); None where
            pillars and cells are the same.
        frame_cells: cells of the map that each frame occupies; without pooling its pillars.
    """

    features: Tensor
    pillar_index: Tensor
    point_counts: Tensor
    cells: Tensor
    frame_pillars: Sequence[int]
    neck: NeckRulebooks[Tensor] | None = None
    pooling: MapCells[Tensor] | None = None
    frame_cells: Sequence[int] = ()


class LabeledPillars(NamedTuple):
    """Pillars of B frames with the targets of their anchors."""

    pillars: PillarBatch
    targets: TargetBatch


@dataclass(frozen=True)
class PillarPreparation:
    """The `Preparation` of pillar detectors.

    Args:
        spec: grid, limits and classes.
        active_cells: of a sparse neck, whose rulebooks are built here; None for a dense one.
        assigner: what matches anchors with boxes.
    """

    spec: PillarSpec
    active_cells: MaskRule | None = None
    assigner: Assigner = "overlap"

    def prepare(self, frame: LabeledFrame, rng: np.random.Generator | None) -> TargetedPillars:
        """Return the pillars of a frame and the targets of its anchors; nothing is random."""
        spec = self.spec
        frame = within_ranges(frame, spec.ranges)
        pillars = spec.pillarize(frame.points)
        targets = assign_targets(
            spec.anchors, spec.classes, frame.boxes, frame.labels, self.assigner, spec.direction_offset_rad
        )
        return TargetedPillars(pillars, self.place(pillars), targets)

    def collate(self, frames: Sequence[TargetedPillars]) -> LabeledPillars:
        """Collate frames into one batch."""
        return LabeledPillars(
            batch_pillars([frame.pillars for frame in frames], [frame.placement for frame in frames]),
            batch_targets([frame.targets for frame in frames]),
        )

    def place(self, pillars: Pillars) -> Placement:
        """Return the map cells of the pillars and, for a sparse neck, the rulebooks: indices (M, 9)."""
        grid = self.spec.grid
        pooling = map_cells(pillars.cells, grid)
        if self.active_cells is None:
            return Placement(pooling, None)
        builder = NeckRulebookBuilder(*grid.map_shape, self.active_cells, training=True)
        return Placement(pooling, builder.build(pillars.cells if pooling is None else pooling.cells))


def batch_pillars(frames: Sequence[Pillars], placements: Sequence[Placement] = ()) -> PillarBatch:
    """Concatenate the pillars of several frames.

    Args:
        frames: at least one, each with features (M, 9), positions among them in metres, and flat indices (P,).
        placements: of each frame; without them the neck is dense and its map the pillars' own.
    """
    frame_pillars = [len(frame.cells) for frame in frames]
    starts = np.concatenate([[0], np.cumsum(frame_pillars)[:-1]]).astype(np.int64)
    poolings = [placement.pooling for placement in placements if placement.pooling is not None]
    rulebooks = [placement.rulebooks for placement in placements if placement.rulebooks is not None]
    frame_cells = [len(pooling.cells) for pooling in poolings] or frame_pillars
    return PillarBatch(
        features=torch.from_numpy(np.concatenate([frame.features for frame in frames])),
        pillar_index=torch.from_numpy(
            np.concatenate([frame.pillar_index + start for frame, start in zip(frames, starts, strict=True)])
        ),
        point_counts=torch.from_numpy(np.concatenate([frame.point_counts for frame in frames])),
        cells=torch.from_numpy(np.concatenate([frame.cells for frame in frames])),
        frame_pillars=frame_pillars,
        neck=_batch_rulebooks(rulebooks, frame_cells),
        pooling=_batch_poolings(poolings, starts),
        frame_cells=frame_cells,
    )


def _batch_rulebooks(
    rulebooks: Sequence[NeckRulebooks[NDArray[np.int32]]], frame_cells: Sequence[int]
) -> NeckRulebooks[Tensor] | None:
    if not rulebooks:
        return None
    batch: NeckRulebooks[Tensor] = tree_map_only(
        np.ndarray, torch.from_numpy, stack_neck_rulebooks(rulebooks, frame_cells)
    )
    return batch


def _batch_poolings(
    poolings: Sequence[MapCells[NDArray[np.int64]]], first_pillars: NDArray[np.int64]
) -> MapCells[Tensor] | None:
    if not poolings:
        return None
    rows = [pooling.pillars + first for pooling, first in zip(poolings, first_pillars, strict=True)]
    return MapCells(
        torch.from_numpy(np.concatenate([pooling.cells for pooling in poolings])),
        torch.from_numpy(np.concatenate(rows)),
        torch.from_numpy(np.concatenate([pooling.counts for pooling in poolings])),
    )


def batch_targets(frames: Sequence[Targets]) -> TargetBatch:
    """Concatenate the anchor targets of several frames."""
    anchors_per_frame = frames[0].state.size
    return TargetBatch(
        state=torch.from_numpy(np.stack([frame.state for frame in frames])),
        positives=torch.from_numpy(
            np.concatenate([frame.positives + i * anchors_per_frame for i, frame in enumerate(frames)])
        ),
        anchors=torch.from_numpy(np.concatenate([frame.anchors for frame in frames])),
        residuals=torch.from_numpy(np.concatenate([frame.residuals for frame in frames])),
        directions=torch.from_numpy(np.concatenate([frame.directions for frame in frames])),
    )
