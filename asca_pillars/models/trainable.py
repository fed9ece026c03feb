"""What a family of detectors is to training, evaluation and checkpoints, and a trained detector on single scans."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from asca_pillars.data.frames import LabeledFrame
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.geometry.frame_change import FrameChange


class Movable(Protocol):
    """A batch of tensors that can move to a device."""

    def to(self, device: Any) -> Self:
        """The same batch with its tensors on `device`."""
        ...


class Preparation(Protocol):
    """Frames to input and targets of a network. Loader processes do it, so it is pickled and holds no weights."""

    def prepare(self, frame: LabeledFrame, rng: np.random.Generator | None) -> Any:
        """One frame, NumPy arrays only.

        Args:
            frame: points and boxes in the LiDAR frame; boxes may lie outside the detector's ranges.
            rng: draws what the detector's limits leave to chance; None chooses the same every time.
        """
        ...

    def collate(self, frames: Sequence[Any]) -> Movable:
        """What `prepare` gave for B frames as one batch of tensors."""
        ...


class Trainable(nn.Module, ABC):
    """A detector that can be trained.

    Outputs are the family's own: what `predict` gives goes to `loss` and to `detect` only.
    """

    preparation: Preparation
    """How its batches are made."""

    @abstractmethod
    def predict(self, batch: Any) -> Any:
        """Outputs of the network for a batch that `preparation.collate` made."""

    @abstractmethod
    def loss(self, outputs: Any, batch: Any) -> Mapping[str, Tensor]:
        """Weighted terms of the loss by name, scalars; training minimizes their sum."""

    @abstractmethod
    def detect(self, outputs: Any, spec: DetectorSpec) -> list[Detections]:
        """Detections of each of the B frames, best first, with the thresholds of `spec`."""


class ScanDetector:
    """Detect objects in one scan after the other.

    Args:
        network: in evaluation mode; its scans are computed where its weights are.
        spec: classes and thresholds that belong to the weights.
        to_model: from the scans' frame to that of the training; None: they are the same.
    """

    def __init__(self, network: Trainable, spec: DetectorSpec, to_model: FrameChange | None = None) -> None:
        self.network = network
        self.spec = spec
        self._to_model = None if to_model is None or to_model.is_identity else to_model
        self._device = next(network.parameters()).device

    def __call__(self, points: NDArray[np.float32]) -> Detections:
        """(N, 4) x, y, z in metres (LiDAR frame) and reflectance 0..1 -> boxes, best first."""
        if self._to_model is not None:
            points = self._to_model.points(points)
        unlabeled = LabeledFrame("", points, np.empty((0, 7), np.float32), np.empty(0, np.int64))
        preparation = self.network.preparation
        batch = preparation.collate([preparation.prepare(unlabeled, None)]).to(self._device)
        with torch.inference_mode():
            found = self.network.detect(self.network.predict(batch), self.spec)[0]
        if self._to_model is not None:
            found = replace(found, boxes=self._to_model.inverse.boxes(found.boxes))
        return found
