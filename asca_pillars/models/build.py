"""Construction of networks from a model's section of the configuration.

Trained weights in their network, together with the configuration that they belong to.
"""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, assert_never

from asca_pillars.base.errors import ConfigError, TrainingError
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.config.tree import Config, DataConfig, ModelConfig
from asca_pillars.config.two_stage import RefineModel
from asca_pillars.data.frames import LabeledSplit
from asca_pillars.models.checkpoint_file import read_checkpoint
from asca_pillars.models.pillar.network import build_pillar_detector
from asca_pillars.models.pillar.preparation import PillarPreparation
from asca_pillars.models.pv_rcnn.network import build_pv_rcnn_detector
from asca_pillars.models.pv_rcnn.preparation import VoxelPreparation
from asca_pillars.models.trainable import Preparation, Trainable
from asca_pillars.models.two_stage.network import build_refine_detector
from asca_pillars.models.two_stage.preparation import cached_preparation
from asca_pillars.scans.input_check import ExpectedInput


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
