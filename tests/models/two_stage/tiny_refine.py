"""A first stage on disk and the configuration of a second one, both small enough to be trained in seconds."""

import dataclasses
from pathlib import Path

from asca_pillars.config.pillar import CpaReading
from asca_pillars.config.tree import AugmentConfig, Config, DataConfig, TrainConfig
from asca_pillars.config.two_stage import RefineConfig, RefineModel, RefineNetwork
from asca_pillars.detection.proposals import ProposalSettings
from asca_pillars.models.two_stage.first_stage import with_first_stage
from asca_pillars.ops.two_stage.first_stage import FirstStageSettings, KeypointSettings
from asca_pillars.ops.two_stage.prepare import RefineSettings
from tests.export.tiny import tiny_checkpoint
from tests.helpers.saved_checkpoint import save_checkpoint

REFINE = RefineConfig(
    seen=FirstStageSettings(ProposalSettings(quotas=(6, 6, 6), candidates=40), KeypointSettings(count=48)),
    neighbors=RefineSettings(ball_samples=6, grid_size=2, grid_samples=5),
    network=RefineNetwork(ball_widths=(8, 12), keypoint_channels=16, grid_widths=(12,), hidden=16),
    rois=8,
)
STILL_OBJECTS = AugmentConfig(object_rotation_rad=0.0, object_shift_m=0.0)


def write_first_stage(path: Path, cpa: CpaReading = "channel") -> Path:
    """The tiny pillar detector as a checkpoint of `asca train`."""
    save_checkpoint(path, tiny_checkpoint(cpa))
    return path


def tiny_refine_config(first_stage: Path, **recipe: object) -> Config:
    """Two epochs of two frames a step on the proposals of that first stage."""
    train = {"epochs": 2, "batch_size": 2, "learning_rate": 1e-3, "checkpoint_steps": 1} | recipe
    return Config(
        name="tiny_refine",
        model=tiny_refine_model(first_stage),
        augment=STILL_OBJECTS,
        data=DataConfig(workers=0),
        train=TrainConfig(**train),  # type: ignore[arg-type]
    )


def tiny_refine_model(first_stage: Path) -> RefineModel:
    return RefineModel(first_stage=str(first_stage), refine=REFINE)


def opened_config(first_stage: Path) -> Config:
    """As `tiny_refine_config`, with what the first stage says of itself, as `asca train` fills it in."""
    config = tiny_refine_config(first_stage)
    return dataclasses.replace(config, model=with_first_stage(tiny_refine_model(first_stage)))
