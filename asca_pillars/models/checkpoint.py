"""Trained weights in their network, together with the configuration that they belong to."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from asca_pillars.base.errors import ConfigError, TrainingError
from asca_pillars.config.tree import Config, ModelConfig
from asca_pillars.models.build import build_model
from asca_pillars.models.checkpoint_file import read_checkpoint
from asca_pillars.models.trainable import Trainable
from asca_pillars.scans.expected_input import ExpectedInput


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
