"""A trained detector on single scans in PyTorch, behind the same interface as `asca_deploy.Detector`."""

import numpy as np
import torch
from numpy.typing import NDArray

from asca_pillars.data.frames import LabeledFrame
from asca_pillars.geometry.detections import Detections
from asca_pillars.geometry.detector_spec import DetectorSpec
from asca_pillars.models.trainable import Trainable


class ScanDetector:
    """Detect objects in one scan after the other.

    Args:
        network: in evaluation mode; its scans are computed where its weights are.
        spec: classes and thresholds that belong to the weights.
    """

    def __init__(self, network: Trainable, spec: DetectorSpec) -> None:
        self.network = network
        self.spec = spec
        self._device = next(network.parameters()).device

    def __call__(self, points: NDArray[np.float32]) -> Detections:
        """(N, 4) x, y, z in metres (LiDAR frame) and reflectance 0..1 -> boxes, best first."""
        unlabeled = LabeledFrame("", points, np.empty((0, 7), np.float32), np.empty(0, np.int64))
        preparation = self.network.preparation
        batch = preparation.collate([preparation.prepare(unlabeled, None)]).to(self._device)
        with torch.inference_mode():
            return self.network.detect(self.network.predict(batch), self.spec)[0]
