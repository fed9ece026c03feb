"""Which frames form which batch: a function of the seed and of the optimizer's step, so that a run can be resumed."""

import math
from collections.abc import Callable, Iterator

import numpy as np
from torch.utils.data import Sampler

from asca_pillars.base.errors import TrainingError


class EpochSampler(Sampler[list[tuple[int, int]]]):
    """Batches of (epoch, frame number), whose order depends on the seed and the optimizer's step alone.

    A resumed run starts at the batch after the last one that the checkpoint knew. Every rank gets the same number
    of batches, or the ranks would wait for each other for ever: frames that do not fill a batch on every rank wait for
    the next epoch's order, and in validation the first frames are seen again by the ranks that would have one less.

    Args:
        frames: number of frames.
        batch_size: frames per batch and rank.
        seed: of the order.
        step: tells the optimizer steps done so far; None walks once through all frames in order (validation).
    """

    def __init__(
        self,
        frames: int,
        batch_size: int,
        seed: int,
        step: Callable[[], int] | None,
        *,
        rank: int = 0,
        world_size: int = 1,
    ) -> None:
        if step is not None and frames < batch_size * world_size:
            raise TrainingError(
                f"{frames} training frames do not fill one batch of {batch_size} on {world_size} device(s); "
                "lower train.batch_size or add frames"
            )
        self.frames, self.batch_size, self.seed, self.step = frames, batch_size, seed, step
        self.rank, self.world_size = rank, world_size

    def __len__(self) -> int:
        if self.step is None:
            return math.ceil(math.ceil(self.frames / self.world_size) / self.batch_size)
        return self.frames // (self.batch_size * self.world_size)

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        step = self.step() if self.step is not None else 0
        epoch, start = divmod(step, len(self)) if self.step is not None else (0, 0)
        order = np.arange(self.frames)
        if self.step is not None:
            order = np.random.default_rng((self.seed, epoch)).permutation(self.frames)
        else:
            order = np.resize(order, math.ceil(self.frames / self.world_size) * self.world_size)
        own = order[self.rank :: self.world_size].tolist()
        batches = [own[i * self.batch_size : (i + 1) * self.batch_size] for i in range(start, len(self))]
        return iter([[(epoch, number) for number in batch] for batch in batches])
