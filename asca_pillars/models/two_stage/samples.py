"""Training samples of the second stage, and batches of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from asca_pillars.data.frames import LabeledFrame
from asca_pillars.models.two_stage.loss import RefineTargets
from asca_pillars.models.two_stage.pillar_refiner import RefineInputs
from asca_pillars.ops.two_stage.first_stage import Proposed
from asca_pillars.ops.two_stage.prepare import RefineScan, RefineSettings, refine_scan
from asca_pillars.ops.two_stage.rois import (
    Overlaps,
    RoiTargets,
    keypoint_states,
    roi_targets,
)


@dataclass(frozen=True)
class RefineSample:
    """One frame with the proposals that are learnt from, and what to say of them."""

    scan: RefineScan
    targets: RoiTargets
    sizes: NDArray[np.float32]
    """(S, 3) of the sampled proposals."""
    keypoint_states: NDArray[np.int8]


class RefineBatch(NamedTuple):
    """Samples of B frames as tensors."""

    inputs: RefineInputs
    targets: RefineTargets


def sample_of(
    frame: LabeledFrame,
    proposed: Proposed,
    overlaps: Overlaps,
    rows: NDArray[np.int64],
    settings: RefineSettings,
) -> RefineSample:
    """Neighbours and targets of the proposals `rows` (S,), which have these `overlaps` with the frame's boxes."""
    chosen = proposed.proposals[rows]
    return RefineSample(
        scan=refine_scan(frame.points, proposed, chosen, settings),
        targets=roi_targets(proposed.proposals, frame.boxes, overlaps, rows),
        sizes=chosen.boxes[:, 3:6],
        keypoint_states=keypoint_states(proposed.keypoints, frame.boxes, frame.labels),
    )


def collate_samples(samples: Sequence[RefineSample]) -> RefineBatch:
    """Samples of several frames, one frame's after the other's."""
    targets = [sample.targets for sample in samples]
    return RefineBatch(
        collate_scans([sample.scan for sample in samples]),
        RefineTargets(
            confidence=_joined([target.confidence for target in targets]),
            positive=_joined([target.positive for target in targets]),
            residuals=_joined([target.residuals for target in targets]),
            sizes=_joined([sample.sizes for sample in samples]),
            keypoint_states=_joined([sample.keypoint_states for sample in samples]),
        ),
    )


def collate_scans(scans: Sequence[RefineScan]) -> RefineInputs:
    """Scans of several frames, one frame's after the other's; indices then count through the batch."""
    points = [len(scan.points) for scan in scans]
    keypoints = [len(scan.keypoints) for scan in scans]
    return RefineInputs(
        points=_joined([scan.points for scan in scans]),
        keypoints=_joined([scan.keypoints for scan in scans]),
        bev=_joined([scan.bev for scan in scans]),
        ball_indices=_counted_through([scan.ball_indices for scan in scans], points),
        grid_points=_joined([scan.grid_points for scan in scans]),
        grid_indices=_counted_through([scan.grid_indices for scan in scans], keypoints),
        roi_features=_joined([scan.roi_features for scan in scans]),
    )


def _counted_through(frames: Sequence[tuple[NDArray[np.int32], ...]], rows: Sequence[int]) -> tuple[Tensor, ...]:
    """Indices of each radius; those of a frame move by the rows of the frames before it, "nothing" to the very end."""
    total, starts = sum(rows), np.cumsum([0, *rows[:-1]])
    return tuple(
        _joined(
            [
                np.where(indices < count, indices + start, total).astype(np.int32)
                for indices, count, start in zip(radius, rows, starts, strict=True)
            ]
        )
        for radius in zip(*frames, strict=True)
    )


def _joined(arrays: Sequence[NDArray[np.generic]]) -> Tensor:
    return torch.from_numpy(np.concatenate(arrays))
