"""Checkpoints as `asca train` writes them, of detectors that no run has trained."""

from pathlib import Path
from typing import Any

import torch

from asca_pillars.base.schema import to_dict
from asca_pillars.models.build import Checkpoint


def checkpoint_content(checkpoint: Checkpoint) -> dict[str, Any]:
    """What the file holds."""
    assert isinstance(checkpoint.detector, torch.nn.Module)
    weights = {f"detector.{name}": value for name, value in checkpoint.detector.state_dict().items()}
    expected = checkpoint.expected_input
    about = {"config": to_dict(checkpoint.config), "expected_input": None if expected is None else to_dict(expected)}
    return {"hyper_parameters": about, "state_dict": weights, "global_step": checkpoint.steps}


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    torch.save(checkpoint_content(checkpoint), path)
