"""Labelled frames to batches of PV-RCNN."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from asca_pillars.data.frames import LabeledFrame, within_ranges
from asca_pillars.detection.targets import Targets, assign_targets
from asca_pillars.models.pillar.preparation import batch_targets
from asca_pillars.models.pv_rcnn.batch import LabeledVoxels, batch_scans
from asca_pillars.ops.pv_rcnn.prepare import VoxelScan, VoxelSetSettings, voxel_scan
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec
from asca_pillars.ops.two_stage.rois import keypoint_states


class TargetedVoxels(NamedTuple):
    """One frame: its scan, the targets of its anchors and keypoints, and its labelled boxes."""

    scan: VoxelScan
    targets: Targets
    keypoint_states: NDArray[np.int8]
    boxes: NDArray[np.float32]
    labels: NDArray[np.int64]


@dataclass(frozen=True)
class VoxelPreparation:
    """The `Preparation` of PV-RCNN.

    Args:
        spec: grid and classes.
        settings: keypoints and neighbors.
    """

    spec: VoxelSpec
    settings: VoxelSetSettings

    def prepare(self, frame: LabeledFrame, rng: np.random.Generator | None) -> TargetedVoxels:
        """Voxels, tables, keypoints and targets of a frame; nothing is drawn."""
        spec = self.spec
        frame = within_ranges(frame, spec.ranges)
        points = frame.points[np.isfinite(frame.points).all(axis=1)]
        scan = voxel_scan(points, spec, self.settings, spec.table_builder(training=True))
        return TargetedVoxels(
            scan,
            assign_targets(
                spec.anchors,
                spec.classes,
                frame.boxes,
                frame.labels,
                direction_offset_rad=spec.direction_offset_rad,
            ),
            keypoint_states(scan.keypoints, frame.boxes, frame.labels),
            frame.boxes,
            frame.labels,
        )

    def collate(self, frames: Sequence[TargetedVoxels]) -> LabeledVoxels:
        """Frames as one batch."""
        return LabeledVoxels(
            batch_scans([frame.scan for frame in frames], self.spec),
            batch_targets([frame.targets for frame in frames]),
            torch.from_numpy(np.concatenate([frame.keypoint_states for frame in frames])),
            tuple(frame.boxes for frame in frames),
            tuple(frame.labels for frame in frames),
        )
