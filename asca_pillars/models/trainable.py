"""Interface of a family of detectors for training, evaluation and checkpoints."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils._pytree import tree_map_only

from asca_pillars.data.frames import LabeledFrame
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.spec import DetectorSpec

BatchT = TypeVar("BatchT")


def to_device(batch: BatchT, device: str | torch.device) -> BatchT:
    """Return a batch with its tensors on `device`; a GPU copies pinned ones while the host goes on."""
    non_blocking = torch.device(device).type == "cuda"
    moved: BatchT = tree_map_only(Tensor, lambda tensor: tensor.to(device, non_blocking=non_blocking), batch)
    return moved


class Preparation(Protocol):
    """Conversion of frames to a network's input and targets. Pickled for loader processes, so it holds no weights."""

    def prepare(self, frame: LabeledFrame, rng: np.random.Generator | None) -> Any:
        """Prepare one frame, as NumPy arrays only.

        Args:
            frame: points and boxes in the LiDAR frame; boxes may lie outside the detector's ranges.
            rng: draws what the detector's limits leave to chance; None chooses the same every time.
        """
        ...

    def collate(self, frames: Sequence[Any]) -> Any:
        """Collate the results of `prepare` for B frames into one batch: tensors in NamedTuples, to any depth."""
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
