"""A trained detector on single scans in PyTorch, behind the same interface as `asca_deploy.Detector`."""

import numpy as np
import torch
from numpy.typing import NDArray

from asca_pillars.geometry.decode import HeadMaps
from asca_pillars.geometry.detections import Detections
from asca_pillars.models.pillar.pillar_detector import PillarBatch, PillarDetector, batch_pillars
from asca_pillars.pillars.pillar_spec import PillarSpec


class ScanDetector:
    """Detect objects in one scan after the other.

    Args:
        network: in evaluation mode; its scans are computed where its weights are.
        spec: grid, classes and thresholds that belong to the weights.
    """

    def __init__(self, network: PillarDetector, spec: PillarSpec) -> None:
        self.network = network
        self.spec = spec
        self._device = next(network.parameters()).device

    def __call__(self, points: NDArray[np.float32]) -> Detections:
        """(N, 4) x, y, z in metres (LiDAR frame) and reflectance 0..1 -> boxes, best first."""
        features, pillar_index, point_counts, cells, frame_pillars = batch_pillars([self.spec.pillarize(points)])
        batch = PillarBatch(
            features.to(self._device),
            pillar_index.to(self._device),
            point_counts.to(self._device),
            cells.to(self._device),
            frame_pillars,
        )
        with torch.inference_mode():
            maps = self.network(batch)
        return self.spec.decode(HeadMaps(*(part[0].float().cpu().numpy() for part in maps)))
