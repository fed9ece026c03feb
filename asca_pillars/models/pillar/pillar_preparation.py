"""Frames to pillars and targets, and batches of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from asca_pillars.data.frames import LabeledFrame, within_ranges
from asca_pillars.geometry.targets import Targets, assign_targets
from asca_pillars.models.pillar.loss import TargetBatch
from asca_pillars.pillars.pillar_spec import PillarSpec
from asca_pillars.pillars.pillarize import Pillars


class PreparedPillars(NamedTuple):
    """One frame: its pillars, and the targets of its anchors."""

    pillars: Pillars
    targets: Targets


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


class LabeledPillars(NamedTuple):
    """Pillars of B frames with the targets of their anchors."""

    pillars: PillarBatch
    targets: TargetBatch

    def to(self, device: Any) -> "LabeledPillars":
        """The same with its tensors on `device`."""
        pillars = self.pillars
        moved = PillarBatch(
            pillars.features.to(device),
            pillars.pillar_index.to(device),
            pillars.point_counts.to(device),
            pillars.cells.to(device),
            pillars.frame_pillars,
        )
        return LabeledPillars(moved, TargetBatch(*(part.to(device) for part in self.targets)))


@dataclass(frozen=True)
class PillarPreparation:
    """The `Preparation` of pillar detectors with the grid, limits and classes of `spec`."""

    spec: PillarSpec

    def prepare(self, frame: LabeledFrame, rng: np.random.Generator | None) -> PreparedPillars:
        """Pillars of a frame and the targets of its anchors; `rng` draws what the limits drop."""
        spec = self.spec
        frame = within_ranges(frame, spec.ranges)
        pillars = spec.pillarize(frame.points, rng)
        return PreparedPillars(pillars, assign_targets(spec.anchors, spec.classes, frame.boxes, frame.labels))

    def collate(self, frames: Sequence[PreparedPillars]) -> LabeledPillars:
        """Frames as one batch."""
        return LabeledPillars(
            batch_pillars([frame.pillars for frame in frames]), _batch_targets([frame.targets for frame in frames])
        )


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


def _batch_targets(frames: Sequence[Targets]) -> TargetBatch:
    anchors_per_frame = frames[0].state.size
    return TargetBatch(
        state=torch.from_numpy(np.stack([frame.state for frame in frames])),
        positives=torch.from_numpy(
            np.concatenate([frame.positives + i * anchors_per_frame for i, frame in enumerate(frames)])
        ),
        residuals=torch.from_numpy(np.concatenate([frame.residuals for frame in frames])),
        directions=torch.from_numpy(np.concatenate([frame.directions for frame in frames])),
    )
