"""Training and validation batches from loader processes."""

import atexit
import contextlib
import math
import multiprocessing
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import lightning as L  # noqa: N812  (Lightning's own convention)
import numpy as np
import torch
from torch.utils.data import DataLoader, Sampler

from asca_pillars.base.errors import TrainingError, WorkerError
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.config.tree import Config
from asca_pillars.training.dataset import Collate, LabeledDataset, open_dataset
from asca_pillars.training.shared_batches import ShareCollated, loader_context, start_loader_process

LOOK_AGAIN_S = 5
"""Seconds without a batch after which the loop checks that all processes live."""
MOST_LOOKS = 180
"""Looks without a batch after which it gives up: a quarter of an hour, in which the run was not suspended."""
_REMEDY = (
    "lower data.workers or set data.workers=0, or give a container more memory (--memory, --shm-size); the same "
    "command resumes from the last checkpoint"
)


class BatchLoader(DataLoader[Any]):
    """A `DataLoader` that ends with one line, and never waits forever, when its processes fail."""

    _processes: frozenset[Any] = frozenset()

    def __iter__(self) -> Iterator[Any]:  # type: ignore[override]
        """Yield the batches.

        Raises:
            WorkerError: a process has ended, cannot be started or cannot send a batch, or there is none for too long.
        """
        if self.num_workers == 0:
            yield from super().__iter__()
            return
        batches: Any = None
        looks = 0
        while True:
            try:
                batches = self._start() if batches is None else batches
                batch = next(batches)
            except StopIteration:
                return
            except (OSError, EOFError, RuntimeError) as error:
                text = " ".join(str(error).split())
                if text.startswith("Caught ") and "in pin memory thread" not in text:  # an error of a loader process
                    raise
                late = text.startswith("DataLoader timed out")
                looks += 1
                if late and looks < MOST_LOOKS:
                    if batches is None:  # late answers to the start of an epoch would be taken for batches
                        self._iterator = None
                    continue
                _kill(self)
                reason = f"no batch in {looks * LOOK_AGAIN_S} seconds" if late else text
                raise WorkerError(f"the processes that load batches failed ({reason}); {_REMEDY}") from None
            looks = 0
            yield batch

    def _start(self) -> Iterator[Any]:
        """Yield batches of one epoch; notes the processes that the first one starts."""
        # torch's loader leaves a traceback where it gets no lock; here are as many as its queues have, and some more.
        _ = [loader_context().Lock() for _ in range(4 * self.num_workers + 8)]
        others = set(multiprocessing.active_children())
        batches = super().__iter__()
        if started := set(multiprocessing.active_children()) - others:
            self._processes |= started
            # Python's own exit sends them a SIGTERM, which they do not follow the first time, and waits for them.
            atexit.register(_kill, weakref.proxy(self))
        return batches


def _kill(loader: BatchLoader) -> None:
    """End the processes of a loader, if it has any: one that is stopped or keeps waiting hears nothing else."""
    with contextlib.suppress(ReferenceError):  # the loader is gone, and they with it
        for process in loader._processes:
            process.kill()


class DetectionData(L.LightningDataModule):
    """Training and validation frames of one dataset."""

    def __init__(self, config: Config, root: str | Path, reporter: Reporter = SILENT) -> None:
        super().__init__()
        self.batch_size, self.seed, self.workers = config.train.batch_size, config.train.seed, config.data.workers
        self.training_set = open_dataset(root, config, training=True, reporter=reporter)
        self.validation_set = open_dataset(root, config, training=False, reporter=reporter)
        for frames in (self.training_set.frames, self.validation_set.frames):
            frames.split.require_files()

    def train_dataloader(self) -> DataLoader[Any]:
        """Return shuffled batches, beginning at the trainer's step."""
        return self._loader(self.training_set, lambda: self.trainer.global_step if self.trainer else 0)

    def val_dataloader(self) -> DataLoader[Any]:
        """Return batches of all validation frames in order."""
        return self._loader(self.validation_set, None)

    def _loader(self, frames: LabeledDataset, step: Callable[[], int] | None) -> DataLoader[Any]:
        trainer = self.trainer
        sampler = EpochSampler(
            len(frames),
            self.batch_size,
            self.seed,
            step,
            rank=trainer.global_rank if trainer else 0,
            world_size=trainer.world_size if trainer else 1,
        )
        collate = Collate(frames.preparation)
        if self.workers == 0:
            return BatchLoader(frames, batch_sampler=sampler, collate_fn=collate)
        return BatchLoader(
            frames,
            batch_sampler=sampler,
            num_workers=self.workers,
            collate_fn=ShareCollated(collate),
            persistent_workers=True,
            worker_init_fn=start_loader_process,
            multiprocessing_context=loader_context(),
            timeout=LOOK_AGAIN_S,
            pin_memory=torch.cuda.is_available(),  # else the training waits for each copy, a third of a step
        )


class EpochSampler(Sampler[list[tuple[int, int]]]):
    """Batches of (epoch, frame number), whose order depends on the seed and the optimizer's step alone.

    A resumed run starts at the batch after the last one that the checkpoint knew. Every rank gets the same number
    of batches, or the ranks would wait for each other for ever: frames that do not fill a batch on every rank wait for
    the next epoch's order, and in validation the first frames are seen again by the ranks that would have one less.

    Args:
        frames: number of frames.
        batch_size: frames per batch and rank.
        seed: of the order.
        step: returns the optimizer steps so far; None: all frames once, in order (validation).
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
        rank_order = order[self.rank :: self.world_size].tolist()
        batches = [rank_order[i * self.batch_size : (i + 1) * self.batch_size] for i in range(start, len(self))]
        return iter([[(epoch, number) for number in batch] for batch in batches])
