"""Training samples: frames of a KITTI-layout folder as pillars with targets, and batches of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from asca_pillars.config import Config
from asca_pillars.data.augment import LabeledFrame, augment
from asca_pillars.data.kitti import KittiSplit, boxes_from_objects, in_image
from asca_pillars.data.scans import read_scan
from asca_pillars.errors import DatasetError
from asca_pillars.geometry.boxes import points_in_boxes
from asca_pillars.geometry.pillarize import Pillars
from asca_pillars.models.detector import PillarBatch, batch_pillars
from asca_pillars.models.loss import TargetBatch
from asca_pillars.models.targets import IGNORED, Targets, assign_targets

# What KITTI's protocol treats as neither right nor wrong for a class.
NEIGHBOR_TYPES = {"Car": "Van", "Pedestrian": "Person_sitting"}


@dataclass(frozen=True)
class Sample:
    """One frame, ready for the network: its pillars, and the targets of its anchors."""

    frame: LabeledFrame
    pillars: Pillars
    targets: Targets


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
        self.pillars = batch_pillars([sample.pillars for sample in samples])
        self.targets = _collate_targets([sample.targets for sample in samples])

    def to(self, device: Any) -> "Batch":
        """Move the tensors, in place, as Lightning expects of a batch."""
        pillars = self.pillars
        self.pillars = PillarBatch(
            pillars.features.to(device),
            pillars.pillar_index.to(device),
            pillars.point_counts.to(device),
            pillars.cells.to(device),
            pillars.frame_pillars,
        )
        self.targets = TargetBatch(*(part.to(device) for part in self.targets))
        return self


class KittiTrainingSet(Dataset[Sample]):
    """Frames of one ImageSets list, augmented when `training`.

    What a sample holds depends on the seed, the epoch and the frame alone, not on the number of workers or on what
    was drawn before it: a resumed run sees what an unbroken one would have seen. An index is therefore a pair
    (epoch, frame number), see `EpochSampler`.

    Raises:
        DatasetError: a missing list, scan, label or calibration file.
    """

    def __init__(self, root: str | Path, config: Config, *, training: bool) -> None:
        self.config = config
        self.training = training
        self.split = KittiSplit(root, config.data.train_set if training else config.data.val_set)
        self.frame_ids = self.split.frame_ids

    def __len__(self) -> int:
        return len(self.frame_ids)

    def __getitem__(self, index: tuple[int, int]) -> Sample:
        epoch, number = index
        rng = np.random.default_rng((self.config.train.seed, epoch, number)) if self.training else None
        frame = read_frame(self.split, self.frame_ids[number], self.config)
        if rng is not None:
            frame = augment(frame, self.config.augment, rng)
        spec = self.config.detector
        pillars = spec.pillarize(frame.points, rng)
        return Sample(frame, pillars, assign_targets(spec.anchors, spec.classes, frame.boxes, frame.labels))


def read_frame(split: KittiSplit, frame_id: str, config: Config) -> LabeledFrame:
    """Points and labelled boxes of one frame, as DataConfig wants them.

    Objects of other types are left out; neighbours of a class (KITTI's Van for Car) and objects with too few points
    become IGNORED.

    Raises:
        DatasetError: a missing or damaged file, or an object of a class without a 3D box.
    """
    calibration = split.calibration(frame_id)
    points = read_scan(split.scan_path(frame_id)).points
    if config.data.camera_view:
        points = points[in_image(points, calibration, split.image_size_wh(frame_id))]
    names = config.detector.class_names
    known = {NEIGHBOR_TYPES[name]: IGNORED for name in names if name in NEIGHBOR_TYPES}
    known |= {name: index for index, name in enumerate(names)}
    objects = [item for item in split.objects(frame_id) if item.type in known]
    if flat := [item.type for item in objects if not item.has_box_3d]:
        raise DatasetError(
            f"{split.label_path(frame_id)}: a {flat[0]} has no 3D box, its sizes are not all positive; "
            "complete the line, or make it DontCare"
        )
    boxes = boxes_from_objects(objects, calibration)
    labels = np.array([known[item.type] for item in objects], dtype=np.int64)
    labels[points_in_boxes(points, boxes).sum(axis=0) < config.data.min_points] = IGNORED
    return LabeledFrame(frame_id, points, boxes, labels)


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
