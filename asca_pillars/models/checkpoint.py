"""Trained weights together with the configuration that they belong to."""

from pathlib import Path
from typing import Any, NamedTuple

import torch

from asca_pillars.config import Config
from asca_pillars.data.expected_input import ExpectedInput
from asca_pillars.errors import ConfigError, TrainingError
from asca_pillars.models.pillar.pillar_detector import PillarDetector, build_pillar_detector
from asca_pillars.schema import parse


class Checkpoint(NamedTuple):
    """A trained detector in evaluation mode, its configuration, and the optimizer steps behind it."""

    config: Config
    detector: PillarDetector
    steps: int
    expected_input: ExpectedInput | None = None
    """What the training scans looked like; None in checkpoints that do not say so."""


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Read a checkpoint of `asca train`, weights only: nothing in the file is executed.

    Raises:
        TrainingError: not a checkpoint, damaged, or made by an incompatible version.
    """
    path = Path(path)
    if not path.is_file():
        raise TrainingError(f"{path}: no such checkpoint; a run keeps its own in RUN/checkpoints/last.ckpt")
    try:
        content: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        config = parse(Config, content["hyper_parameters"]["config"], str(path))
        detector = build_pillar_detector(config.model)
        weights = {
            name.removeprefix("detector."): value
            for name, value in content["state_dict"].items()
            if name.startswith("detector.")
        }
        detector.load_state_dict(weights)
    except ConfigError as error:
        raise TrainingError(f"{error}; the checkpoint was made by another version of asca-pillars") from None
    except Exception as error:  # torch.load raises whatever the damaged bytes happen to trigger
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise TrainingError(f"{path}: not a checkpoint of `asca train`, or damaged ({reason})") from error
    expected = content["hyper_parameters"].get("expected_input")
    expected_input = None if expected is None else parse(ExpectedInput, expected, str(path))
    return Checkpoint(config, detector.eval(), int(content["global_step"]), expected_input)
