"""The one place where a model's section of the configuration becomes a network."""

from typing import assert_never

from asca_pillars.config import ModelConfig, PillarModel
from asca_pillars.models.pillar.pillar_detector import build_pillar_detector
from asca_pillars.models.pillar.pillar_preparation import PillarPreparation
from asca_pillars.models.trainable import Preparation, Trainable


def build_model(model: ModelConfig) -> Trainable:
    """The network that `model` describes, with fresh random weights."""
    match model:
        case PillarModel():
            return build_pillar_detector(model)
        case _:
            assert_never(model)


def build_preparation(model: ModelConfig) -> Preparation:
    """What makes batches for that network; without it, for whoever only looks at samples."""
    match model:
        case PillarModel():
            network = model.network
            return PillarPreparation(model.spec, network.active_cells if network.neck == "sparse" else None)
        case _:
            assert_never(model)
