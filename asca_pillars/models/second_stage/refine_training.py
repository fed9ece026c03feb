"""Training the second stage on the proposals of a frozen first stage."""

import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch

from asca_pillars.errors import TrainingError
from asca_pillars.models.refine.pillar_refiner import PillarRefiner
from asca_pillars.models.refine.refine_loss import RefineTerms, refine_loss
from asca_pillars.models.second_stage.refine_sample import RefineBatch, RefineSample, collate_samples

_CLIP = 10.0  # largest norm of the whole gradient (PV-RCNN)


def sample_batches(
    prepare: Callable[[int, np.random.Generator], RefineSample], frames: int, batch_size: int, seed: int
) -> Iterator[RefineBatch]:
    """Batches without end, epoch after epoch in new orders; what one holds depends on the seed and its place alone.

    Args:
        prepare: the sample of frame 0 <= number < frames; draws from the generator.
        batch_size: frames of a batch; those that are left at the end of an epoch wait for another order.
    """
    if frames < batch_size:
        raise TrainingError(f"{frames} training frames do not fill one batch of {batch_size}; add frames")
    epoch = 0
    while True:
        order = np.random.default_rng((seed, epoch)).permutation(frames)
        for start in range(0, frames - batch_size + 1, batch_size):
            numbers: Sequence[int] = order[start : start + batch_size].tolist()
            yield collate_samples([prepare(n, np.random.default_rng((seed, epoch, n))) for n in numbers])
        epoch += 1


def train_refiner(
    network: PillarRefiner,
    batches: Iterator[RefineBatch],
    *,
    learning_rate: float,
    weight_decay: float = 0.01,
    steps: int | None = None,
    seconds: float | None = None,
    report: Callable[[int, RefineTerms], None] | None = None,
) -> int:
    """Train for so many steps or seconds with Adam and one cycle of the rate; leaves the network in evaluation mode.

    Returns:
        The optimizer's steps.

    Raises:
        TrainingError: neither or both of `steps` and `seconds`, or a loss that is not finite.
    """
    if (steps is None) == (seconds is None):
        raise TrainingError("give either steps or seconds")
    optimizer = torch.optim.AdamW(network.parameters(), lr=learning_rate, weight_decay=weight_decay)
    network.train()
    begin, step = time.monotonic(), 0
    while (done := step / steps if steps else (time.monotonic() - begin) / (seconds or 1)) < 1:
        for group in optimizer.param_groups:
            group["lr"] = learning_rate * one_cycle(done)
        batch = next(batches)
        terms = refine_loss(network(batch.inputs), batch.targets)
        if not torch.isfinite(terms.total):
            name = next(name for name, value in terms._asdict().items() if not torch.isfinite(value))
            raise TrainingError(f"loss term `{name}` is not finite at step {step}; lower the learning rate")
        optimizer.zero_grad()
        terms.total.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), _CLIP)
        optimizer.step()
        step += 1
        if report is not None:
            report(step, terms)
    network.eval()
    return step


def one_cycle(done: float, rising: float = 0.4, divide: float = 10.0) -> float:
    """Share of the largest learning rate: up from 1 / `divide` along a cosine, then down to almost nothing."""
    if done < rising:
        return 1 / divide + (1 - 1 / divide) * (1 - np.cos(np.pi * done / rising)) / 2
    return float(max((1 + np.cos(np.pi * (done - rising) / (1 - rising))) / 2, 1e-4))
