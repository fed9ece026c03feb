"""Training and validation batches, loaded by processes of their own."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning as L  # noqa: N812  (Lightning's own convention)
from torch.utils.data import DataLoader

from asca_pillars.config import Config
from asca_pillars.training.dataset import Collate, LabeledDataset, open_dataset
from asca_pillars.training.loader_processes import leave_interrupts_to_the_loop, loader_context
from asca_pillars.training.sampler import EpochSampler


class DetectionData(L.LightningDataModule):
    """Training and validation frames of one dataset."""

    def __init__(self, config: Config, root: str | Path) -> None:
        super().__init__()
        self.batch_size, self.seed, self.workers = config.train.batch_size, config.train.seed, config.data.workers
        self.training_set = open_dataset(root, config, training=True)
        self.validation_set = open_dataset(root, config, training=False)
        for frames in (self.training_set.frames, self.validation_set.frames):
            frames.split.require_files()

    def train_dataloader(self) -> DataLoader[Any]:
        """Shuffled batches, from the step on at which the trainer stands."""
        return self._loader(self.training_set, lambda: self.trainer.global_step if self.trainer else 0)

    def val_dataloader(self) -> DataLoader[Any]:
        """All validation frames in order."""
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
        return DataLoader(
            frames,
            batch_sampler=sampler,
            num_workers=self.workers,
            collate_fn=Collate(frames.preparation),
            persistent_workers=self.workers > 0,
            worker_init_fn=leave_interrupts_to_the_loop,
            multiprocessing_context=loader_context() if self.workers else None,
        )
