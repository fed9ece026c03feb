"""Batches from loader processes to the training process through anonymous memory, whatever the size of /dev/shm.

torch hands tensors over in files of /dev/shm. Where that is full, as in containers (64 MiB by default), the thread that
sends a batch fails, the batch is lost, and the training waits for it forever. Memory of `memfd_create` (Linux) is
limited by nothing but the memory that there is, and one descriptor carries a whole batch.
"""

import mmap
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing import reduction
from multiprocessing.context import ForkServerContext
from multiprocessing.queues import Queue
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_map_only

from asca_pillars.base.errors import AscaError, WorkerError
from asca_pillars.training.dataset import Batch, Sample

_ALIGNMENT = 64
"""Bytes; torch's own allocation. Sums of vectorized loops may depend on where a tensor begins."""


@dataclass(frozen=True)
class _Placed:
    """The place of a tensor in the memory of its batch."""

    offset: int
    shape: torch.Size
    dtype: torch.dtype


class SharedInputs:
    """The inputs of a batch in anonymous memory; the process that unpickles it gets the inputs themselves.

    Args:
        inputs: tensors in tuples and NamedTuples, to any depth; what is not a tensor travels as it is.

    Raises:
        OSError: no memory, or no more open files.
    """

    def __init__(self, inputs: Any) -> None:
        self.size = 0
        descriptor = os.memfd_create("batch")
        try:
            with open(descriptor, "wb", closefd=False) as file:
                self.placed = tree_map_only(Tensor, lambda tensor: self._place(tensor, file), inputs)
            self.memory = reduction.DupFd(descriptor)
        finally:
            os.close(descriptor)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return _opened, (self.placed, self.memory, self.size)

    def _place(self, tensor: Tensor, file: Any) -> _Placed:
        array = tensor.contiguous().numpy()
        offset = -(-self.size // _ALIGNMENT) * _ALIGNMENT
        self.size = offset + array.nbytes
        if array.nbytes:
            file.seek(offset)
            file.write(array.reshape(-1).data)
        return _Placed(offset, tensor.shape, tensor.dtype)


def _opened(placed: Any, memory: Any, size: int) -> Any:
    """Return the inputs of a `SharedInputs`, tensors on the same memory."""
    descriptor = memory.detach()
    try:
        content = mmap.mmap(descriptor, size) if size else b""
    finally:
        os.close(descriptor)

    def tensor(place: _Placed) -> Tensor:
        count = place.shape.numel()
        if count == 0:
            return torch.empty(place.shape, dtype=place.dtype)
        return torch.frombuffer(content, dtype=place.dtype, count=count, offset=place.offset).reshape(place.shape)

    return tree_map_only(_Placed, tensor, placed)


@dataclass(frozen=True)
class ShareCollated:
    """Collate function of loader processes, with the tensors of its batches in anonymous memory.

    A batch that cannot be stored becomes the error that the training ends with.
    """

    collate: Callable[[Sequence[Sample | AscaError]], Batch | AscaError]

    def __call__(self, samples: Sequence[Sample | AscaError]) -> Batch | AscaError:
        """Make a batch, or return the first error."""
        try:
            batch = self.collate(samples)
            if isinstance(batch, Batch) and hasattr(os, "memfd_create"):
                batch.inputs = SharedInputs(batch.inputs)  # unpickled it is the inputs
        except (OSError, MemoryError) as error:
            return WorkerError(
                f"no room for a batch of {len(samples)} frames ({error or type(error).__name__}); "
                "lower train.batch_size or data.workers, or set data.workers=0"
            )
        return batch


def loader_context() -> ForkServerContext:
    """Return the multiprocessing context in which `DataLoader` starts its processes.

    Each process would import torch for itself otherwise: seconds of start, and hundreds of MiB that are shared now.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["asca_pillars.training.shared_batches", __name__])
    return context


def start_loader_process(_: int) -> None:
    """Set up a loader process before its first batch."""
    ignore_interrupts()
    # Else the batch would be lost, and the loop would wait for it forever: it notices a process that has ended.
    Queue._on_queue_feeder_error = staticmethod(_end)  # type: ignore[attr-defined]


def ignore_interrupts() -> None:
    """Ignore Ctrl-C and the first SIGTERM, which reach every process, in favor of the training loop.

    A step that is under way still needs its batch. A second SIGTERM ends the process: it is the loader's own.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: signal.signal(signal.SIGTERM, signal.SIG_DFL) and None)


def _end(error: Exception, _: Any) -> None:
    """End a process that cannot send what it loaded."""
    print(f"loader process {os.getpid()}: {' '.join(str(error).split())}", file=sys.stderr, flush=True)
    os._exit(1)
