"""Construction of networks from a model's section of the configuration."""

from typing import assert_never

from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.config.tree import DataConfig, ModelConfig
from asca_pillars.config.two_stage import RefineModel
from asca_pillars.data.frames import LabeledSplit
from asca_pillars.models.pillar.network import build_pillar_detector
from asca_pillars.models.pillar.preparation import PillarPreparation
from asca_pillars.models.pv_rcnn.network import build_pv_rcnn_detector
from asca_pillars.models.pv_rcnn.preparation import VoxelPreparation
from asca_pillars.models.trainable import Preparation, Trainable
from asca_pillars.models.two_stage.network import build_refine_detector
from asca_pillars.models.two_stage.preparation import cached_preparation


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
