"""Training samples: frames of a KITTI-layout folder, augmented and prepared for a family of detectors."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.data import Dataset

from asca_pillars.config import AugmentConfig, Config
from asca_pillars.data.augment import augment
from asca_pillars.data.frames import LabeledFrame, read_frame, within_ranges
from asca_pillars.data.insertion.insert_objects import Inserter, insert_objects, prepare_inserter
from asca_pillars.data.labeled_split import LabeledSplit
from asca_pillars.data.open_split import open_split
from asca_pillars.errors import AscaError
from asca_pillars.geometry.detector_spec import DetectorSpec
from asca_pillars.models.build import build_preparation
from asca_pillars.models.trainable import Movable, Preparation


@dataclass(frozen=True)
class Sample:
    """One frame, and what the detector's `Preparation` made of it."""

    frame: LabeledFrame
    prepared: Any


@dataclass
class Batch:
    """Samples of B frames.

    Attributes:
        frame_ids: names of the frames.
        boxes: (M, 7) labelled boxes of each frame, NumPy, LiDAR frame, metres and radians; for evaluation.
        labels: (M,) class indices of each frame's boxes, or IGNORED.
        inputs: input and targets of the network, tensors.
    """

    frame_ids: list[str]
    boxes: list[np.ndarray]
    labels: list[np.ndarray]
    inputs: Movable

    def to(self, device: Any) -> "Batch":
        """Move the tensors, in place, as Lightning expects of a batch."""
        self.inputs = self.inputs.to(device)
        return self


@dataclass(frozen=True)
class Collate:
    """Samples to a `Batch`; an object, because loader processes pickle it.

    An error in the place of a sample stands for the whole batch: torch wraps what a loader process raises into the
    text of its traceback, and the loop is to raise the one line itself.
    """

    preparation: Preparation

    def __call__(self, samples: Sequence[Sample | AscaError]) -> Batch | AscaError:
        """Make a batch, or give the first error."""
        good = []
        for sample in samples:
            if isinstance(sample, AscaError):
                return sample
            good.append(sample)
        return Batch(
            frame_ids=[sample.frame.frame_id for sample in good],
            boxes=[sample.frame.boxes for sample in good],
            labels=[sample.frame.labels for sample in good],
            inputs=self.preparation.collate([sample.prepared for sample in good]),
        )


class LabeledDataset(Dataset[Sample | AscaError]):
    """Frames of one ImageSets list, augmented where `augmentation` is given.

    What a sample holds depends on the seed, the epoch and the frame alone, not on the number of workers or on what
    was drawn before it: a resumed run sees what an unbroken one would have seen. An index is therefore a pair
    (epoch, frame number), see `EpochSampler`.

    Args:
        split: the list.
        spec: classes that are labels, and ranges outside of which a box is no target.
        preparation: of the detector that is trained.
        camera_view: keep only the points that the camera sees.
        min_points: an object with fewer points inside its box is IGNORED.
        augmentation: random changes; None for validation.
        inserter: puts objects of other frames in, before anything else is changed.
        seed: of all that is drawn.
    """

    def __init__(
        self,
        split: LabeledSplit,
        spec: DetectorSpec,
        preparation: Preparation,
        *,
        camera_view: bool,
        min_points: int,
        augmentation: AugmentConfig | None = None,
        inserter: Inserter | None = None,
        seed: int = 0,
    ) -> None:
        self.split, self.spec, self.preparation = split, spec, preparation
        self.camera_view, self.min_points = camera_view, min_points
        self.augmentation, self.inserter, self.seed = augmentation, inserter, seed
        self.frame_ids = split.frame_ids

    def __len__(self) -> int:
        return len(self.frame_ids)

    def __getitem__(self, index: tuple[int, int]) -> Sample | AscaError:
        """The sample (epoch, frame number), or what is wrong with the files of that frame."""
        try:
            return self.sample(*index)
        except AscaError as error:
            return error

    def sample(self, epoch: int, number: int) -> Sample:
        """One sample.

        Raises:
            DatasetError, ScanError: a file of the frame is missing or damaged.
        """
        rng = None if self.augmentation is None else np.random.default_rng((self.seed, epoch, number))
        frame = read_frame(
            self.split,
            self.frame_ids[number],
            self.spec.class_names,
            camera_view=self.camera_view,
            min_points=self.min_points,
        )
        if self.inserter is not None:
            # A generator of its own: all other draws stay what they are without insertion.
            frame = insert_objects(frame, self.inserter, np.random.default_rng((self.seed, epoch, number, 1)))
        if self.augmentation is not None and rng is not None:
            frame = augment(frame, self.augmentation, rng)
        return Sample(within_ranges(frame, self.spec.ranges), self.preparation.prepare(frame, rng))


def open_dataset(root: str | Path, config: Config, *, training: bool) -> LabeledDataset:
    """The training or the validation frames that `config` asks for; the object database is built if it is missing.

    Raises:
        DatasetError: a missing list, scan, label or calibration file; a class to insert that no frame has.
    """
    data, spec, insert = config.data, config.model.spec, config.augment.insert
    split = open_split(root, data.train_set if training else data.val_set)
    inserter = None
    if training and insert.method != "none":
        inserter = prepare_inserter(split, spec, data, insert)
    return LabeledDataset(
        split,
        spec,
        build_preparation(config.model, split, data),
        camera_view=data.camera_view,
        min_points=data.min_points,
        augmentation=config.augment if training else None,
        inserter=inserter,
        seed=config.train.seed,
    )
