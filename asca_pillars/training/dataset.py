"""Training samples: frames of a KITTI-layout folder as pillars with targets, and batches of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from asca_pillars.config import Config
from asca_pillars.data.augment import augment
from asca_pillars.data.frames import LabeledFrame, read_frame, within_grid
from asca_pillars.data.insertion.insert_objects import Inserter, insert_objects, prepare_inserter
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.geometry.targets import Targets, assign_targets
from asca_pillars.models.pillar.loss import TargetBatch, targets_at
from asca_pillars.models.pillar.pillar_detector import batch_pillars
from asca_pillars.pillars.pillarize import Pillars
from asca_pillars.tables.neck_tables import NeckTableBuilder, NeckTables


@dataclass(frozen=True)
class Sample:
    """One frame, ready for the network: its pillars, the targets of its anchors, and the tables of a sparse neck."""

    frame: LabeledFrame
    pillars: Pillars
    targets: Targets
    tables: NeckTables[NDArray[np.int32]] | None = None


class Batch:
    """Samples of B frames as tensors.

    Attributes:
        frame_ids: names of the frames.
        pillars: input of `PillarDetector`.
        targets: input of `detection_loss`.
        boxes, labels: the labelled boxes of each frame, NumPy, for evaluation.
    """

    def __init__(self, samples: Sequence[Sample]) -> None:
        self.frame_ids = [sample.frame.frame_id for sample in samples]
        self.boxes = [sample.frame.boxes for sample in samples]
        self.labels = [sample.frame.labels for sample in samples]
        self.pillars = batch_pillars([sample.pillars for sample in samples], [sample.tables for sample in samples])
        self.targets = _collate_targets([sample.targets for sample in samples])

    def to(self, device: Any) -> "Batch":
        """Move the tensors, in place, as Lightning expects of a batch."""
        self.pillars = self.pillars.to(device)
        self.targets = TargetBatch(*(part.to(device) for part in self.targets))
        return self

    def seen_targets(self) -> TargetBatch:
        """Targets of the anchors that the network has: all, or those at the active head cells of a sparse neck."""
        neck = self.pillars.neck
        return self.targets if neck is None else targets_at(self.targets, neck.head_cells)


class KittiDataset(Dataset[Sample]):
    """Frames of one ImageSets list, augmented when `training`; the object database is built here if it is missing.

    What a sample holds depends on the seed, the epoch and the frame alone, not on the number of workers or on what
    was drawn before it: a resumed run sees what an unbroken one would have seen. An index is therefore a pair
    (epoch, frame number), see `EpochSampler`.

    Raises:
        DatasetError: a missing list, scan, label or calibration file; a class to insert that no frame has.
    """

    def __init__(self, root: str | Path, config: Config, *, training: bool) -> None:
        self.config = config
        self.training = training
        self.split = KittiSplit(root, config.data.train_set if training else config.data.val_set)
        self.frame_ids = self.split.frame_ids
        self.inserter: Inserter | None = None
        if training and config.augment.insert.method != "none":
            self.inserter = prepare_inserter(self.split, config)

    def __len__(self) -> int:
        return len(self.frame_ids)

    def __getitem__(self, index: tuple[int, int]) -> Sample:
        epoch, number = index
        rng = np.random.default_rng((self.config.train.seed, epoch, number)) if self.training else None
        data, spec = self.config.data, self.config.detector
        frame = read_frame(
            self.split,
            self.frame_ids[number],
            spec.class_names,
            camera_view=data.camera_view,
            min_points=data.min_points,
        )
        if self.inserter is not None:
            # A generator of its own: all other draws stay what they are without insertion.
            frame = insert_objects(
                frame, self.inserter, np.random.default_rng((self.config.train.seed, epoch, number, 1))
            )
        if rng is not None:
            frame = augment(frame, self.config.augment, rng)
        frame = within_grid(frame, spec.grid)
        pillars = spec.pillarize(frame.points, rng)
        targets = assign_targets(spec.anchors, spec.classes, frame.boxes, frame.labels)
        network, tables = self.config.network, None
        if network.neck == "sparse":
            builder = NeckTableBuilder(spec.grid.ny, spec.grid.nx, network.active_cells, training=True)
            tables = builder.build(pillars.cells)
        return Sample(frame, pillars, targets, tables)


def _collate_targets(frames: Sequence[Targets]) -> TargetBatch:
    anchors_per_frame = frames[0].state.size
    return TargetBatch(
        state=torch.from_numpy(np.stack([frame.state for frame in frames])),
        positives=torch.from_numpy(
            np.concatenate([frame.positives + i * anchors_per_frame for i, frame in enumerate(frames)])
        ),
        residuals=torch.from_numpy(np.concatenate([frame.residuals for frame in frames])),
        directions=torch.from_numpy(np.concatenate([frame.directions for frame in frames])),
    )
