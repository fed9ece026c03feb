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
    about = {"config": to_dict(checkpoint.config)}
    return {"hyper_parameters": about, "state_dict": weights, "global_step": checkpoint.steps}


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Without what its scans were like."""
    torch.save(checkpoint_content(checkpoint), path)
