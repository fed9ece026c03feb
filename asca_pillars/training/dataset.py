"""Training samples: labelled frames, augmented and prepared for a family of detectors."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor
from torch.utils._pytree import tree_map_only
from torch.utils.data import Dataset

from asca_pillars.base.errors import AscaError, WorkerError
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.config.tree import Config
from asca_pillars.data.frames import LabeledFrame, within_ranges
from asca_pillars.data.training_frames import TrainingFrames, open_frames
from asca_pillars.models.build import build_preparation
from asca_pillars.models.trainable import Preparation, to_device


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
    inputs: Any

    def to(self, device: Any) -> "Batch":
        """Move the tensors, in place, as Lightning expects of a batch."""
        self.inputs = to_device(self.inputs, device)
        return self

    def pin_memory(self) -> "Batch":
        """Pin the tensors, in place, as `DataLoader` expects of a batch."""
        self.inputs = tree_map_only(Tensor, Tensor.pin_memory, self.inputs)
        return self


@dataclass(frozen=True)
class Collate:
    """Collate function that makes a `Batch` of samples; an object, because loader processes pickle it.

    An error in the place of a sample stands for the whole batch: torch wraps what a loader process raises into the
    text of its traceback, and the loop is to raise the one line itself.
    """

    preparation: Preparation

    def __call__(self, samples: Sequence[Sample | AscaError]) -> Batch | AscaError:
        """Make a batch, or return the first error."""
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
    """Frames as samples for one family of detectors.

    A sample does not depend on the number of workers or on samples before it, so that a resumed run gets the same as an
    uninterrupted one. An index is therefore a pair (epoch, frame number), see `EpochSampler`.

    Args:
        frames: read and augmented.
        preparation: of the detector that is trained.
    """

    def __init__(self, frames: TrainingFrames, preparation: Preparation) -> None:
        self.frames, self.preparation = frames, preparation
        self.frame_ids = frames.frame_ids

    def __len__(self) -> int:
        return len(self.frame_ids)

    def __getitem__(self, index: tuple[int, int]) -> Sample | AscaError:
        """Return the sample (epoch, frame number), or the error in the frame's files."""
        try:
            return self.sample(*index)
        except AscaError as error:
            return error
        except (OSError, MemoryError) as error:
            return WorkerError(f"frame {self.frame_ids[index[1]]} cannot be loaded ({error or type(error).__name__})")

    def sample(self, epoch: int, number: int) -> Sample:
        """Read and prepare one sample.

        Raises:
            DatasetError, ScanError: a file of the frame is missing or damaged.
        """
        frame, rng = self.frames.draw(epoch, number)
        return Sample(within_ranges(frame, self.frames.spec.ranges), self.preparation.prepare(frame, rng))


def open_dataset(root: str | Path, config: Config, *, training: bool, reporter: Reporter = SILENT) -> LabeledDataset:
    """Open the training or the validation samples of `config`.

    Raises:
        DatasetError: as `open_frames`.
    """
    frames = open_frames(root, config, training=training, reporter=reporter)
    return LabeledDataset(frames, build_preparation(config.model, frames.split, config.data, reporter))
