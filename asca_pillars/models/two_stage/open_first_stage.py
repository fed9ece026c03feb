"""The first stage that a configuration names."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from asca_pillars.base.errors import ConfigError
from asca_pillars.config.two_stage import RefineModel
from asca_pillars.detection.decode import PostProcess
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.ops.two_stage.first_stage import FirstStage

CHECKPOINT_SUFFIX = ".ckpt"


def open_first_stage(source: str) -> FirstStage:
    """A bundle (folder, or name of one that ships) or a checkpoint.

    Raises:
        AscaError: it is missing, damaged, of another family or not in float32; one line.
    """
    path = Path(source)  # of a bundle the folder, which an export replaces as a whole
    return _open_first_stage(source, path.stat().st_mtime_ns if path.exists() else 0)


@lru_cache(maxsize=2)
def _open_first_stage(source: str, _changed_ns: int) -> FirstStage:
    if Path(source).suffix == CHECKPOINT_SUFFIX:
        from asca_pillars.models.two_stage.checkpoint_first_stage import CheckpointFirstStage

        return CheckpointFirstStage(source)
    # Here, because the export stands above this package and is needed for bundles alone.
    from asca_export.two_stage.first_stage import BundleFirstStage

    return BundleFirstStage(source)


def with_first_stage(model: RefineModel) -> RefineModel:
    """The model with all that its first stage says of itself: identity, spec, channels.

    Raises:
        AscaError: as `open_first_stage`.
        ConfigError: the model says something else of it.
    """
    stage = open_first_stage(model.first_stage)
    if model.first_stage_identity not in ("", stage.identity):
        raise ConfigError(
            f"model.first_stage = {model.first_stage}: other weights are there than those that the second stage was "
            "trained on; give it the same bundle or checkpoint, or train again"
        )
    spec = stage.spec
    assert isinstance(spec, PillarSpec), "both kinds of first stages are pillar detectors"
    if model.first_stage_identity == "" and model.spec != PillarSpec():
        raise ConfigError("model.spec is the first stage's where model.kind is pillar_refine: leave it out")
    if _shape(model.spec) != _shape(spec) and model.first_stage_identity:
        raise ConfigError(f"model.spec is not that of the first stage {model.first_stage}: train again")
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


def _shape(spec: PillarSpec) -> PillarSpec:
    """What the first stage computes with; thresholds and suppression are the second stage's own."""
    return replace(spec.with_score_threshold(0.0), post=PostProcess())
