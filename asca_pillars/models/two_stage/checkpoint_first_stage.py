"""A checkpoint as the first stage of two."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from asca_pillars.config.pillar import PillarModel
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.models.checkpoint import load_checkpoint, weights_sha256
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.models.pillar.preparation import batch_pillars
from asca_pillars.ops.two_stage.first_stage import FirstPass, require_pillar_kind


class CheckpointFirstStage:
    """A trained pillar detector in PyTorch, on the CPU; see `ops.two_stage.first_stage.FirstStage`.

    Args:
        path: checkpoint of `asca train`.

    Raises:
        TrainingError: not a checkpoint, damaged, or made by an incompatible version.
        ConfigError: it is of another kind.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = path
        checkpoint = load_checkpoint(path)
        model, detector = checkpoint.config.model, checkpoint.detector
        require_pillar_kind(path, model.kind)
        assert isinstance(model, PillarModel) and isinstance(detector, PillarDetector), "it is of kind pillar"
        self._network = detector
        self.spec = model.spec
        self.identity = weights_sha256(detector.state_dict())

    def __reduce__(self) -> tuple[Any, ...]:
        """Sent to another process, it is read there."""
        return CheckpointFirstStage, (self._path,)

    def __call__(self, points: NDArray[np.float32]) -> FirstPass:
        """See `FirstStage`."""
        network, pillars = self._network, self.spec.pillarize(points)
        batch = batch_pillars([pillars], [network.preparation.place(pillars)])
        with torch.inference_mode():
            features = network.head_input(batch)
            maps = network.read_head(features, batch)
        if batch.neck is not None:
            rows = HeadMaps(*(part.numpy() for part in maps))
            return FirstPass(rows, features.numpy(), batch.neck.head_cells.int().numpy())
        channels_last = np.ascontiguousarray(features[0].permute(1, 2, 0).numpy())
        return FirstPass(HeadMaps(*(part[0].numpy() for part in maps)), channels_last)
