"""A trained detector on single scans in PyTorch, behind the same interface as `asca_deploy.Detector`."""

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from asca_pillars.data.frames import LabeledFrame
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.models.trainable import Trainable


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
