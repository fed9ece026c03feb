"""Batches of PV-RCNN from labelled frames; indices count through the batch."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils._pytree import tree_map_only

from asca_pillars.data.frames import LabeledFrame, within_ranges
from asca_pillars.detection.targets import Targets, assign_targets
from asca_pillars.models.pillar.loss import TargetBatch
from asca_pillars.models.pillar.preparation import batch_targets
from asca_pillars.ops.points.neighbors import PointScale, ball_query
from asca_pillars.ops.pv_rcnn.prepare import VoxelScan, VoxelSetSettings, voxel_scan
from asca_pillars.ops.pv_rcnn.rulebooks import VoxelLevel, stack_voxel_levels
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec
from asca_pillars.ops.sparse.rulebooks import stack_cells, stack_rows
from asca_pillars.ops.two_stage.decode import keypoint_states

Array = TypeVar("Array")


class VoxelBatch(NamedTuple, Generic[Array]):
    """B scans as arrays or tensors, see `ops.pv_rcnn.prepare.VoxelScan`."""

    features: Array
    """(N, 4) of the voxels."""
    levels: tuple[VoxelLevel[Array], ...]
    """conv1 to conv4 and conv_out."""
    points: Array
    """(P, 4)."""
    keypoints: Array
    """(K, 3)."""
    positions: tuple[Array, ...]
    """(N, 3) per source."""
    ball_indices: tuple[Array, ...]
    """(K, samples), source by source and radius by radius."""
    nearest: tuple[Array, ...]
    """(K, 3) voxels per source, (0, 3) where they are not needed."""
    nearest_weights: tuple[Array, ...]
    """(K, 3)."""
    bev_cells: Array
    """(K, 4) flat indices into the maps of all frames."""
    bev_weights: Array
    """(K, 4)."""
    scales: tuple[PointScale[Array], ...]
    """Settings for raw points around keypoints."""
    frame_keypoints: tuple[int, ...]
    """Keypoints of each frame."""
    frame_rows: tuple[tuple[int, ...], ...]
    """Number of `positions` in each frame, per source."""


class LabeledVoxels(NamedTuple):
    """B scans, the targets of their anchors and keypoints, and the boxes for the other targets."""

    scans: VoxelBatch[Tensor]
    anchors: TargetBatch
    keypoint_states: Tensor
    """(K,) int8: 1 in an object, 0 outside, -1 takes no part."""
    boxes: tuple[NDArray[np.float32], ...]
    """(M, 7) per frame, metres and radians, LiDAR frame."""
    labels: tuple[NDArray[np.int64], ...]
    """(M,) per frame, or IGNORED."""


def batch_scans(scans: Sequence[VoxelScan], spec: VoxelSpec) -> VoxelBatch[Tensor]:
    """Batch several scans, at least one."""
    levels = stack_voxel_levels([scan.levels for scan in scans], spec.level_shapes)
    sources = range(len(scans[0].positions))
    frame_rows = tuple(tuple(len(scan.positions[source]) for scan in scans) for source in sources)
    rows, columns = spec.map_shape
    batch: VoxelBatch[NDArray[Any]] = VoxelBatch(
        features=np.concatenate([scan.features for scan in scans]),
        levels=tuple(levels),
        points=np.concatenate([scan.points for scan in scans]),
        keypoints=np.concatenate([scan.keypoints for scan in scans]),
        positions=tuple(np.concatenate([scan.positions[source] for scan in scans]) for source in sources),
        ball_indices=tuple(
            stack_rows([scan.ball_indices[source][ball] for scan in scans], frame_rows[source])
            for source in sources
            for ball in range(len(scans[0].ball_indices[source]))
        ),
        nearest=tuple(stack_rows([scan.nearest[source] for scan in scans], frame_rows[source]) for source in sources),
        nearest_weights=tuple(np.concatenate([scan.nearest_weights[source] for scan in scans]) for source in sources),
        bev_cells=stack_cells([scan.bev_cells for scan in scans], rows * columns),
        bev_weights=np.concatenate([scan.bev_weights for scan in scans]),
        scales=_stack_scales(scans),
        frame_keypoints=tuple(len(scan.keypoints) for scan in scans),
        frame_rows=frame_rows,
    )
    tensors: VoxelBatch[Tensor] = tree_map_only(np.ndarray, torch.from_numpy, batch)
    return tensors


def _stack_scales(scans: Sequence[VoxelScan]) -> tuple[PointScale[NDArray[Any]], ...]:
    stacked, finer = [], [len(scan.points) for scan in scans]
    for scales in zip(*(scan.scales for scan in scans), strict=True):
        rows = [len(scale.positions) for scale in scales]
        stacked.append(
            PointScale(
                np.concatenate([scale.positions for scale in scales]),
                stack_rows([scale.groups for scale in scales], finer),
                stack_rows([scale.nearest for scale in scales], rows),
                np.concatenate([scale.nearest_weights for scale in scales]),
            )
        )
        finer = rows
    return tuple(stacked)


def deformed_balls(
    batch: VoxelBatch[Tensor], settings: VoxelSetSettings, places: Mapping[str, Sequence[Tensor]]
) -> tuple[list[Tensor], list[Tensor]]:
    """Return indices (K, samples) and centers (K, 3), metres, of all balls; deformed sources' around `places`."""
    indices, centers, given = [], [], iter(batch.ball_indices)
    for number, sa in enumerate(settings.sources):
        for radius, (radius_m, samples) in enumerate(zip(sa.radii_m, sa.samples, strict=True)):
            ball_indices = next(given)
            where = places.get(sa.source, [batch.keypoints])
            center = where[min(radius, len(where) - 1)]
            if sa.source in places:
                frames = zip(
                    np.split(batch.positions[number].cpu().numpy(), np.cumsum(batch.frame_rows[number])[:-1]),
                    np.split(center.detach().cpu().numpy(), np.cumsum(batch.frame_keypoints)[:-1]),
                    strict=True,
                )
                balls = [ball_query(rows, queries, radius_m, samples) for rows, queries in frames]
                ball_indices = torch.from_numpy(stack_rows(balls, batch.frame_rows[number])).to(center.device)
            indices.append(ball_indices)
            centers.append(center)
    return indices, centers


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
        """Return voxels, rulebooks, keypoints and targets of a frame; nothing is random."""
        spec = self.spec
        frame = within_ranges(frame, spec.ranges)
        points = frame.points[np.isfinite(frame.points).all(axis=1)]
        scan = voxel_scan(points, spec, self.settings, spec.rulebook_builder(training=True))
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
        """Collate frames into one batch."""
        return LabeledVoxels(
            batch_scans([frame.scan for frame in frames], self.spec),
            batch_targets([frame.targets for frame in frames]),
            torch.from_numpy(np.concatenate([frame.keypoint_states for frame in frames])),
            tuple(frame.boxes for frame in frames),
            tuple(frame.labels for frame in frames),
        )
