"""Interface of a family of detectors for training, evaluation and checkpoints."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Protocol, Self

import numpy as np
from torch import Tensor, nn

from asca_pillars.data.frames import LabeledFrame
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.spec import DetectorSpec


class Movable(Protocol):
    """A batch of tensors that can move to a device."""

    def to(self, device: Any) -> Self:
        """Return the batch with its tensors on `device`."""
        ...


class Preparation(Protocol):
    """Conversion of frames to a network's input and targets. Pickled for loader processes, so it holds no weights."""

    def prepare(self, frame: LabeledFrame, rng: np.random.Generator | None) -> Any:
        """Prepare one frame, as NumPy arrays only.

        Args:
            frame: points and boxes in the LiDAR frame; boxes may lie outside the detector's ranges.
            rng: draws what the detector's limits leave to chance; None chooses the same every time.
        """
        ...

    def collate(self, frames: Sequence[Any]) -> Movable:
        """Collate the results of `prepare` for B frames into one batch of tensors."""
        ...


class Trainable(nn.Module, ABC):
    """A detector that can be trained.

    The type of outputs is the family's: the result of `predict` is only passed to `loss` and `detect`.
    """

    preparation: Preparation
    """Preparation of its batches."""

    @abstractmethod
    def predict(self, batch: Any) -> Any:
        """Return the outputs of the network for a batch that `preparation.collate` made."""

    @abstractmethod
    def loss(self, outputs: Any, batch: Any) -> Mapping[str, Tensor]:
        """Return the weighted terms of the loss by name, scalars; training minimizes their sum."""

    @abstractmethod
    def detect(self, outputs: Any, spec: DetectorSpec) -> list[Detections]:
        """Return detections of each of the B frames, best first, with the thresholds of `spec`."""
