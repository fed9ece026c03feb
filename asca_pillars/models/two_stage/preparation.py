"""Batches of the second stage from labelled frames, with proposals that the frozen first stage makes of each once."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple, Protocol
from zipfile import BadZipFile

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.processes import map_in_processes
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.base.schema import to_dict
from asca_pillars.config.tree import DataConfig
from asca_pillars.config.two_stage import RefineConfig, RefineModel
from asca_pillars.data.augment import move_scene
from asca_pillars.data.frames import LabeledFrame, LabeledSplit, Motion
from asca_pillars.data.insertion.prepared import prepared_folder, require_writable, writable_atomic_path
from asca_pillars.detection.detections import Detections
from asca_pillars.models.two_stage.first_stage import open_first_stage, with_first_stage
from asca_pillars.models.two_stage.layers import RefineInputs
from asca_pillars.models.two_stage.loss import RefineTargets
from asca_pillars.ops.two_stage.decode import (
    Overlaps,
    RoiTargets,
    keypoint_states,
    match_proposals,
    roi_targets,
    sample_rois,
)
from asca_pillars.ops.two_stage.first_stage import FirstStage, FirstStageSettings, SecondStageInputs, run_first_stage
from asca_pillars.ops.two_stage.prepare import RefineScan, RefineSettings, refine_scan

_FORMAT = 3  # format of the files; with another number, old ones are not read


@dataclass(frozen=True)
class ProposalFiles:
    """The files of a cache; loader processes read them without the first stage."""

    folder: Path
    class_names: tuple[str, ...]

    def read(self, frame_id: str) -> SecondStageInputs:
        """Read the first-stage results of a frame.

        Raises:
            DatasetError: its file is missing or damaged.
        """
        path = self.path(frame_id)
        try:
            # Opened here: NumPy leaves a file that it cannot read open.
            with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                detections = Detections(arrays["boxes"], arrays["scores"], arrays["labels"], self.class_names)
                return SecondStageInputs(detections, arrays["keypoints"], arrays["bev"].astype(np.float32))
        except FileNotFoundError:
            raise DatasetError(f"{path}: no proposals of this frame; compute them first") from None
        except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
            raise DatasetError(f"{path}: damaged ({error}); delete it, it will be computed again") from None

    def path(self, frame_id: str) -> Path:
        """Return the path of the frame's file."""
        return self.folder / f"{frame_id}.npz"


class ProposalCache:
    """Files below `prepared`/proposals-KEY, one for each frame; KEY names the first stage and the settings.

    Each file records the state of its frame's points (`points_state`), so that changed frames are detected.

    Args:
        prepared: folder of what is computed once per dataset, see `data.insertion.prepared`.
        pool: what the frames' names are unique in.
        stage: the first stage; can be sent to a process, where several fill the cache.
        camera_view: whether the first stage sees only the points in the image.
    """

    def __init__(
        self, prepared: Path, pool: str, stage: FirstStage, settings: FirstStageSettings, *, camera_view: bool = True
    ) -> None:
        self.prepared, self.stage, self.settings, self.camera_view = prepared, stage, settings, camera_view
        about = {"format": _FORMAT, "stage": stage.identity, "spec": to_dict(stage.spec), "camera_view": camera_view}
        about |= to_dict(settings)
        key = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:12]
        self.files = ProposalFiles(prepared / pool / f"proposals-{key}", stage.spec.class_names)

    def fill(self, split: LabeledSplit, *, workers: int = 1, reporter: Reporter = SILENT) -> None:
        """Compute what is missing or outdated. Each file appears when it is complete, so a killed run can be resumed.

        Args:
            split: frames.
            workers: processes; each opens the first stage for itself.
            reporter: for the progress.

        Raises:
            DatasetError, ScanError: a frame cannot be read, or a file not written.
        """
        todo = [frame_id for frame_id in split.frame_ids if not self._is_current(split, frame_id)]
        if todo:
            require_writable(self.prepared)
        propose = partial(_propose, self.files, split, self.stage, self.settings, self.camera_view)
        for _ in map_in_processes(propose, todo, workers, "Proposing", reporter=reporter):
            pass

    def _is_current(self, split: LabeledSplit, frame_id: str) -> bool:
        """Return whether the frame's file was made from its scan as it is; only the file's stamp is read."""
        try:
            with self.files.path(frame_id).open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                return np.array_equal(arrays["stamp"], _stamp(split, frame_id))
        except (OSError, ValueError, KeyError, EOFError, BadZipFile):  # none there, or a damaged one: it is made again
            return False


def _propose(
    files: ProposalFiles,
    split: LabeledSplit,
    stage: FirstStage,
    settings: FirstStageSettings,
    camera_view: bool,
    frame_id: str,
) -> None:
    stamp = _stamp(split, frame_id)  # before the scan is read: one that changes meanwhile is read again
    points = split.points(frame_id, camera_view=camera_view)
    stage_inputs = run_first_stage(stage, points[np.isfinite(points).all(axis=1)], settings)
    with writable_atomic_path(files.path(frame_id)) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, stamp=stamp, **_arrays(stage_inputs))


def _stamp(split: LabeledSplit, frame_id: str) -> NDArray[np.int64]:
    """Return the state of the files that the proposals were made from; empty if one is missing."""
    try:
        return np.array(split.points_state(frame_id))
    except FileNotFoundError:  # reported, in words, by whoever reads it
        return np.zeros(0, np.int64)


def _arrays(stage_inputs: SecondStageInputs) -> dict[str, NDArray[np.generic]]:
    proposals = stage_inputs.proposals
    return {
        "boxes": proposals.boxes,
        "scores": proposals.scores,
        "labels": proposals.labels,
        "keypoints": stage_inputs.keypoints,
        "bev": stage_inputs.bev.astype(np.float16),  # the bulk of the file, and more digits than a feature is worth
    }


@dataclass(frozen=True)
class RefineSample:
    """One frame with its sampled proposals and their targets."""

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
    proposed: SecondStageInputs,
    overlaps: Overlaps,
    rows: NDArray[np.int64],
    settings: RefineSettings,
) -> RefineSample:
    """Return neighbors and targets of proposals `rows` (S,) with these `overlaps` with the frame's boxes."""
    chosen = proposed.proposals[rows]
    return RefineSample(
        scan=refine_scan(frame.points, proposed, chosen, settings),
        targets=roi_targets(proposed.proposals, frame.boxes, overlaps, rows),
        sizes=chosen.boxes[:, 3:6],
        keypoint_states=keypoint_states(proposed.keypoints, frame.boxes, frame.labels),
    )


def collate_samples(samples: Sequence[RefineSample]) -> RefineBatch:
    """Concatenate the samples of several frames."""
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
    """Concatenate the scans of several frames; indices then count through the batch."""
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
    """Offset each radius's indices by the rows of the frames before; the index for empty entries moves to the end."""
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


class PreparedRefinement(NamedTuple):
    """One frame for the second stage."""

    sample: RefineSample
    proposals: Detections
    """Proposals of the sample, in its order."""
    loss_mask: NDArray[np.bool_]
    """(S,) those that the loss counts."""


class LabeledProposals(NamedTuple):
    """Proposals of B frames with their neighbours and targets."""

    inputs: RefineInputs
    targets: RefineTargets
    loss_mask: Tensor
    """(R,) bool, the proposals that the loss counts."""
    proposals: tuple[Detections, ...]
    """Proposals of each frame."""


class ProposalSource(Protocol):
    """Source of a frame's proposals."""

    def __call__(self, frame: LabeledFrame) -> SecondStageInputs:
        """Return the first-stage results of the frame in its current, perhaps augmented, state."""
        ...


@dataclass(frozen=True)
class CachedProposals:
    """Proposals from the files of a `ProposalCache`, moved as augmentation moved the frame."""

    files: ProposalFiles

    def __call__(self, frame: LabeledFrame) -> SecondStageInputs:
        """See `ProposalSource`."""
        return move_proposed(self.files.read(frame.frame_id), frame.motion)


@dataclass(frozen=True)
class LiveProposals:
    """Proposals of a first stage that runs in this process."""

    stage: FirstStage
    settings: FirstStageSettings

    def __call__(self, frame: LabeledFrame) -> SecondStageInputs:
        """See `ProposalSource`."""
        return run_first_stage(self.stage, frame.points, self.settings)


@dataclass(frozen=True)
class RefinePreparation:
    """The `Preparation` of the second stage."""

    refine: RefineConfig
    source: ProposalSource

    def prepare(self, frame: LabeledFrame, rng: np.random.Generator | None) -> PreparedRefinement:
        """Return neighbors and targets of proposals: sampled ones for training, all of them without `rng`."""
        points = frame.points[np.isfinite(frame.points).all(axis=1)]
        frame = replace(frame, points=points)
        proposed = self.source(frame)
        overlaps = match_proposals(proposed.proposals, frame.boxes, frame.labels)
        every = np.arange(len(proposed.proposals))
        rows = every if rng is None else sample_rois(overlaps, self.refine.rois, rng)
        sample = sample_of(frame, proposed, overlaps, rows, self.refine.neighbors)
        return PreparedRefinement(sample, proposed.proposals[rows], ~overlaps.ignored[rows])

    def collate(self, frames: Sequence[PreparedRefinement]) -> LabeledProposals:
        """Collate frames into one batch."""
        batch = collate_samples([frame.sample for frame in frames])
        loss_mask = torch.from_numpy(np.concatenate([frame.loss_mask for frame in frames]))
        return LabeledProposals(*batch, loss_mask, tuple(frame.proposals for frame in frames))


def cached_preparation(
    model: RefineModel, split: LabeledSplit, data: DataConfig, reporter: Reporter = SILENT
) -> RefinePreparation:
    """Return the preparation for the frames of `split`; proposals that are not on disk yet are computed.

    Raises:
        AscaError: the first stage cannot be opened, a frame not be read, or a file not be written.
    """
    model = with_first_stage(model)
    stage = open_first_stage(model.first_stage)
    folder = prepared_folder(split.root, data)
    view = data.camera_view and split.has_camera
    cache = ProposalCache(folder, split.pool, stage, model.refine.seen, camera_view=view)
    cache.fill(split, workers=max(data.workers, 1), reporter=reporter)
    return RefinePreparation(model.refine, CachedProposals(cache.files))


def live_preparation(model: RefineModel) -> RefinePreparation:
    """Return the preparation for single scans: the first stage runs on each of them.

    Raises:
        AscaError: the first stage cannot be opened, or is not the one of the training.
    """
    model = with_first_stage(model)
    return RefinePreparation(model.refine, LiveProposals(open_first_stage(model.first_stage), model.refine.seen))


def move_proposed(proposed: SecondStageInputs, motion: Motion) -> SecondStageInputs:
    """Move proposals and keypoints with the augmented scene; map features of keypoints stay."""
    proposals = proposed.proposals
    moved = LabeledFrame("", proposed.keypoints.copy(), proposals.boxes.copy(), proposals.labels)
    move_scene(moved, motion)
    return replace(proposed, proposals=replace(proposals, boxes=moved.boxes), keypoints=moved.points)
