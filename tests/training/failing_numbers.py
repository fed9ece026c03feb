"""A dataset whose loader process fails, and its loader; it imports little, because each process imports it."""

import os
import signal
import time
from dataclasses import dataclass
from typing import Any


class Unsendable:
    def __reduce__(self) -> Any:
        raise RuntimeError("unable to allocate shared memory(shm)")


@dataclass(frozen=True)
class Numbers:
    """Gives its indices, and does `what` at the fourth."""

    what: str = ""

    def __len__(self) -> int:
        return 12

    def __getitem__(self, index: int) -> Any:
        if index == 4 and self.what == "unsendable":
            return Unsendable()
        if self.what == "slow":
            time.sleep(1 if index == 4 else 0)
        elif index == 4 and self.what and self.what != "large":
            os.kill(os.getpid(), getattr(signal, self.what))
        return index


def large_batch(_: Any) -> Any:
    import torch

    from asca_pillars.training.dataset import Batch

    return Batch([], [], [], torch.zeros(1_000_000))


def loader_of(what: str, timeout: float = 1) -> Any:
    from asca_pillars.training.loaders import BatchLoader
    from asca_pillars.training.shared_batches import ShareCollated, loader_context, start_loader_process

    return BatchLoader(
        Numbers(what),  # type: ignore[arg-type]
        batch_size=2,
        num_workers=2,
        collate_fn=ShareCollated(large_batch) if what == "large" else list,
        persistent_workers=True,
        worker_init_fn=start_loader_process,
        multiprocessing_context=loader_context(),
        timeout=timeout,
    )
