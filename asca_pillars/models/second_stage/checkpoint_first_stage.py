"""A checkpoint as the first stage of two."""

import hashlib
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from asca_pillars.geometry.decode import HeadMaps
from asca_pillars.models.checkpoint import load_checkpoint
from asca_pillars.models.pillar.pillar_detector import PillarDetector
from asca_pillars.models.pillar.pillar_preparation import batch_pillars
from asca_pillars.pillar_config import PillarModel
from asca_pillars.points.first_stage import FirstPass, require_dense_map


class CheckpointFirstStage:
    """A trained pillar detector in PyTorch, on the CPU; see `points.first_stage.FirstStage`.

    Args:
        path: checkpoint of `asca train`.

    Raises:
        TrainingError: not a checkpoint, damaged, or made by an incompatible version.
        ConfigError: it is of another kind, its neck is sparse, or its map is pooled.
    """

    def __init__(self, path: str | Path) -> None:
        checkpoint = load_checkpoint(path)
        model, detector = checkpoint.config.model, checkpoint.detector
        neck, pooled = "dense", False
        if isinstance(model, PillarModel):
            neck, pooled = model.network.neck, model.spec.grid.pools
        require_dense_map(path, model.kind, neck, pooled=pooled)
        assert isinstance(model, PillarModel) and isinstance(detector, PillarDetector), "it is of kind pillar"
        self._network = detector
        self.spec = model.spec
        with Path(path).open("rb") as file:
            self.identity = hashlib.file_digest(file, "sha256").hexdigest()

    def __call__(self, points: NDArray[np.float32]) -> FirstPass:
        """See `FirstStage`."""
        network, batch = self._network, batch_pillars([self.spec.pillarize(points)])
        with torch.inference_mode():
            pillars = network.encode(batch.features, batch.pillar_index, batch.point_counts, batch.frame_pillars)
            neck = network.neck(network.scatter(pillars, batch.cells, batch.frame_pillars))
            maps = network.head(neck)
        channels_last = np.ascontiguousarray(neck[0].permute(1, 2, 0).numpy())
        return FirstPass(HeadMaps(*(part[0].float().numpy() for part in maps)), channels_last)
