"""A trained detector on single scans in PyTorch, behind the same interface as `asca_deploy.Detector`."""

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.config.tree import Config
from asca_pillars.data.frames import LabeledFrame
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.models.build import load_checkpoint
from asca_pillars.models.trainable import Trainable, to_device
from asca_pillars.scans.mounting import Mounting


class ScanDetector:
    """Detector of single scans in PyTorch.

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
        """Detect: (N, 4) x, y, z in metres (LiDAR frame) and reflectance 0..1 -> boxes, best first."""
        if self._to_model is not None:
            points = self._to_model.points(points)
        unlabeled = LabeledFrame("", points, np.empty((0, 7), np.float32), np.empty(0, np.int64))
        preparation = self.network.preparation
        batch = to_device(preparation.collate([preparation.prepare(unlabeled, None)]), self._device)
        with torch.inference_mode():
            found = self.network.detect(self.network.predict(batch), self.spec)[0]
        if self._to_model is not None:
            found = replace(found, boxes=self._to_model.inverse.boxes(found.boxes))
        return found


class OpenedCheckpoint(NamedTuple):
    """Opened checkpoint: detector, configuration, and description for a report."""

    detector: ScanDetector
    config: Config
    about: dict[str, Any]


def open_checkpoint(
    path: Path, min_score: float, mounting: Mounting, *, device: str = "cpu", threads: int | None = None
) -> OpenedCheckpoint:
    """Open a checkpoint for detection in PyTorch.

    Args:
        path: of the file.
        min_score: lowest score of what it reports.
        mounting: of the scans.
        device: cpu, cuda, or auto for cuda where there is one.
        threads: of the CPU; None: as PyTorch chooses.

    Raises:
        TrainingError: the checkpoint is missing or damaged.
        ConfigError: there is no CUDA device.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise ConfigError("provider cuda: PyTorch finds no CUDA device here; choose cpu")
    device = "cpu" if device == "cpu" or not torch.cuda.is_available() else "cuda"
    if threads is not None:
        torch.set_num_threads(threads)
    loaded = load_checkpoint(path)
    config = loaded.config
    about = {
        "name": config.name,
        "checkpoint": str(path),
        "steps": loaded.steps,
        "provider": f"torch {device}",
        "threads": torch.get_num_threads(),
        "min_score": min_score,
    }
    expected = loaded.expected_input
    to_model = mounting.to_model(None if expected is None else expected.sensor_height_m)
    spec = config.model.spec.with_score_threshold(min_score)
    return OpenedCheckpoint(ScanDetector(loaded.detector.to(device), spec, to_model), config, about)
