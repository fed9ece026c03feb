"""The first stage that a configuration names, in PyTorch: a checkpoint, or the weights that a bundle holds."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.config.two_stage import RefineModel
from asca_pillars.detection.decode import HeadMaps, PostProcess
from asca_pillars.models.pillar.preparation import batch_pillars
from asca_pillars.models.pillar.trained import load_trained_pillars
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.ops.two_stage.first_stage import FirstStage, FirstStageOutputs


class TorchFirstStage:
    """A trained pillar detector in PyTorch, on the CPU; see `ops.two_stage.first_stage.FirstStage`.

    Args:
        source: a checkpoint of `asca train`, or a bundle that holds one: its folder, or the name of one that ships.

    Raises:
        AscaError: as `load_trained_pillars`.
    """

    def __init__(self, source: str) -> None:
        self._source = source
        self._network, self.spec, self.identity = load_trained_pillars(source, "model.first_stage")

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as its source, from which the other process reads it."""
        return open_first_stage, (self._source,)

    def __call__(self, points: NDArray[np.float32]) -> FirstStageOutputs:
        """See `FirstStage`."""
        network, pillars = self._network, self.spec.pillarize(points)
        batch = batch_pillars([pillars], [network.preparation.place(pillars)])
        with torch.inference_mode():
            features = network.head_input(batch)
            maps = network.read_head(features, batch)
        if batch.neck is not None:
            rows = HeadMaps(*(part.numpy() for part in maps))
            return FirstStageOutputs(rows, features.numpy(), batch.neck.head_cells.int().numpy())
        channels_last = np.ascontiguousarray(features[0].permute(1, 2, 0).numpy())
        return FirstStageOutputs(HeadMaps(*(part[0].numpy() for part in maps)), channels_last)


def open_first_stage(source: str) -> FirstStage:
    """Return the first stage of that name, cached as long as its file stays the same, see `TorchFirstStage`.

    Raises:
        AscaError: as `TorchFirstStage`.
    """
    path = Path(source)  # for a bundle its folder, which an export replaces as a whole
    return _open_first_stage(source, path.stat().st_mtime_ns if path.exists() else 0)


@lru_cache(maxsize=2)
def _open_first_stage(source: str, _changed_ns: int) -> FirstStage:
    return TorchFirstStage(source)


def with_first_stage(model: RefineModel, stage: FirstStage | None = None) -> RefineModel:
    """Return the model with identity, spec and channels of its first stage.

    Args:
        model: of the second stage.
        stage: the first one, opened; None opens `model.first_stage`.

    Raises:
        AscaError: as `open_first_stage`.
        ConfigError: the model states other properties of it.
    """
    stage = stage or open_first_stage(model.first_stage)
    if model.first_stage_identity not in ("", stage.identity):
        raise ConfigError(
            f"model.first_stage = {model.first_stage}: other weights are there than those that the second stage was "
            "trained on; give it the same bundle or checkpoint, or train again"
        )
    spec = stage.spec
    assert isinstance(spec, PillarSpec), "all first stages are pillar detectors"
    if model.first_stage_identity == "" and model.spec != PillarSpec():
        raise ConfigError("model.spec is the first stage's where model.kind is pillar_refine: leave it out")
    if _geometry(model.spec) != _geometry(spec) and model.first_stage_identity:
        raise ConfigError(f"model.spec is not that of the first stage {model.first_stage}: train again")
    # Votes improve the boxes of the first stage alone, see `RefineModel`.
    spec = replace(spec, post=replace(spec.post, vote_iou=None))
    channels = stage(np.empty((0, 4), np.float32)).neck.shape[-1]
    if model.bev_channels not in (0, channels):
        raise ConfigError(
            f"model.bev_channels = {model.bev_channels}: the map of {model.first_stage} has {channels}; leave it out"
        )
    return replace(
        model,
        first_stage_identity=stage.identity,
        bev_channels=channels,
        spec=model.spec if model.first_stage_identity else spec,
    )


def _geometry(spec: PillarSpec) -> PillarSpec:
    """Return the spec without thresholds and suppression, which are those of the second stage."""
    return replace(spec.with_score_threshold(0.0), post=PostProcess())
