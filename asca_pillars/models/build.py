"""Construction of networks from a model's section of the configuration.

Trained weights in their network, together with the configuration that they belong to.

A trained detector on single scans in PyTorch, behind the same interface as `asca_deploy.Detector`.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, assert_never

import numpy as np
import torch
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError, TrainingError
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.config.tree import Config, DataConfig, ModelConfig
from asca_pillars.config.two_stage import RefineModel
from asca_pillars.data.frames import LabeledFrame, LabeledSplit
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.geometry.frame_change import FrameChange
from asca_pillars.models.checkpoint_file import read_checkpoint
from asca_pillars.models.pillar.network import build_pillar_detector
from asca_pillars.models.pillar.preparation import PillarPreparation
from asca_pillars.models.pv_rcnn.network import build_pv_rcnn_detector
from asca_pillars.models.pv_rcnn.preparation import VoxelPreparation
from asca_pillars.models.trainable import Preparation, Trainable, to_device
from asca_pillars.models.two_stage.network import build_refine_detector
from asca_pillars.models.two_stage.preparation import cached_preparation
from asca_pillars.scans.input_check import ExpectedInput
from asca_pillars.scans.mounting import Mounting


def build_model(model: ModelConfig) -> Trainable:
    """Build the network that `model` describes, with fresh random weights.

    Raises:
        ConfigError: `model` lacks properties of its first stage.
    """
    match model:
        case PillarModel():
            return build_pillar_detector(model)
        case RefineModel():
            return build_refine_detector(model)
        case PvRcnnModel():
            return build_pv_rcnn_detector(model)
        case _:
            assert_never(model)


def build_preparation(
    model: ModelConfig, split: LabeledSplit, data: DataConfig, reporter: Reporter = SILENT
) -> Preparation:
    """Return the `Preparation` of batches for the network; what is computed once per dataset is computed here.

    Raises:
        AscaError: what is computed once per dataset cannot be computed or saved.
    """
    match model:
        case PillarModel():
            network = model.network
            rule = network.active_cells if network.neck == "sparse" else None
            return PillarPreparation(model.spec, rule, model.loss.assigner)
        case RefineModel():
            return cached_preparation(model, split, data, reporter)
        case PvRcnnModel():
            return VoxelPreparation(model.spec, model.settings)
        case _:
            assert_never(model)


class Checkpoint(NamedTuple):
    """A trained detector in evaluation mode and where it comes from.

    Attributes:
        config: of its training run.
        detector: its network.
        steps: optimizer steps behind it.
        expected_input: of the scans that it was trained on; None in checkpoints made before this was measured.
    """

    config: Config
    detector: Trainable
    steps: int
    expected_input: ExpectedInput | None = None

    def with_model(self, model: ModelConfig) -> "Checkpoint":
        """Return the same weights in a network of another `spec`: other ranges, thresholds or post-processing."""
        detector = build_model(model)
        detector.load_state_dict(self.detector.state_dict())
        return self._replace(config=replace(self.config, model=model), detector=detector.eval())


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Read a checkpoint of `asca train`, weights only: nothing in the file is executed.

    last.ckpt, best.ckpt and weights.ckpt are read alike; with `train.ema` the weights are the averaged ones.

    Raises:
        TrainingError: not a checkpoint, damaged, or made by an incompatible version.
    """
    file = read_checkpoint(path)
    try:
        detector = build_model(file.config.model)
    except ConfigError as error:
        raise TrainingError(f"{error}; the checkpoint was made by another version of asca-pillars") from None
    file.fill(detector)
    return Checkpoint(file.config, detector.eval(), file.steps, file.expected_input)


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
            detections = self.network.detect(self.network.predict(batch), self.spec)[0]
        if self._to_model is not None:
            detections = replace(detections, boxes=self._to_model.inverse.boxes(detections.boxes))
        return detections


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
