"""A trained detector on single scans in PyTorch, behind the same interface as `asca_deploy.Detector`."""

import numpy as np
import torch
from numpy.typing import NDArray

from asca_pillars.geometry.detections import Detections
from asca_pillars.models.pillar.pillar_detector import PillarDetector, batch_pillars, frame_maps
from asca_pillars.pillars.spec import DetectorSpec


class ScanDetector:
    """Detect objects in one scan after the other.

    Args:
        network: in evaluation mode; its scans are computed where its weights are.
        spec: grid, classes and thresholds that belong to the weights.
    """

    def __init__(self, network: PillarDetector, spec: DetectorSpec) -> None:
        self.network = network
        self.spec = spec
        self._device = next(network.parameters()).device

    def __call__(self, points: NDArray[np.float32]) -> Detections:
        """(N, 4) x, y, z in metres (LiDAR frame) and reflectance 0..1 -> boxes, best first."""
        pillars = self.spec.pillarize(points)
        batch = batch_pillars([pillars], [self.network.neck_tables(pillars)]).to(self._device)
        with torch.inference_mode():
            maps = self.network(batch)
        ((found, cells),) = frame_maps(maps, batch)
        return self.spec.decode(found, cells)
