"""Learning rates over the optimizer steps of a run."""

import functools
import math
from typing import Any

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR, OneCycleLR, StepLR

from asca_pillars.config.tree import TrainConfig


def make_schedule(optimizer: Optimizer, recipe: TrainConfig, epoch_steps: int) -> Any:
    """The schedule that `recipe` names, stepped once for each optimizer step, of which an epoch has `epoch_steps`."""
    if recipe.schedule == "step":
        # Counted in steps, so that a checkpoint taken just before the end of an epoch holds all of its state.
        return StepLR(optimizer, recipe.decay_epochs * epoch_steps, recipe.decay)
    total_steps = recipe.epochs * epoch_steps
    if recipe.schedule == "warmup_stable_decay":
        return LambdaLR(optimizer, functools.partial(warmup_stable_decay, recipe, total_steps))
    return OneCycleLR(
        optimizer,
        max_lr=recipe.learning_rate,
        total_steps=total_steps,
        pct_start=0.3,  # of fast.ai's one cycle, torch's default, stated because it is the recipe
        div_factor=10,  # as OpenPCDet starts it
    )


def warmup_stable_decay(recipe: TrainConfig, total_steps: int, step: int) -> float:
    """Factor of the learning rate at `step` of `total_steps`: a linear rise, then 1, then a linear fall.

    It is more than 0 at every step from 0 to `total_steps` - 1 (Hu et al., MiniCPM, arXiv 2404.06395).
    """
    rise = (step + 1) / (recipe.warmup_steps + 1)
    fall = (total_steps - step) / (total_steps - cooldown_start(recipe, total_steps) + 1)
    return max(0.0, min(1.0, rise, fall))


def cooldown_start(recipe: TrainConfig, total_steps: int) -> int:
    """First step of `warmup_stable_decay` whose rate depends on how long the run is."""
    return math.ceil((1 - recipe.cooldown) * total_steps)


def steps_per_epoch(recipe: TrainConfig, frames: int, processes: int) -> int:
    """Optimizer steps of one epoch: whole batches of every process."""
    return frames // (recipe.batch_size * processes)
