"""The processes that load batches: forked from a server that has imported, once, what all of them need."""

import multiprocessing
import os
import signal
import sys
from multiprocessing.context import ForkServerContext
from multiprocessing.queues import Queue
from typing import Any


def loader_context() -> ForkServerContext:
    """How `DataLoader` starts its processes.

    Each process would import torch for itself otherwise: seconds of start, and hundreds of MiB that are shared now.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["asca_pillars.training.shared_batches", __name__])
    return context


def start_loader_process(_: int) -> None:
    """What a process does before its first batch."""
    leave_interrupts_to_the_loop()
    # Else the batch would be lost, and the loop would wait for it forever: it notices a process that has ended.
    Queue._on_queue_feeder_error = staticmethod(_end)  # type: ignore[attr-defined]


def leave_interrupts_to_the_loop() -> None:
    """Ctrl-C reaches every process of the terminal, SIGTERM of a batch system every one of the job.

    A step that is under way still needs its batch. A second SIGTERM ends the process: it is the loader's own.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: signal.signal(signal.SIGTERM, signal.SIG_DFL) and None)


def _end(error: Exception, _: Any) -> None:
    """End a process that cannot send what it loaded."""
    print(f"loader process {os.getpid()}: {' '.join(str(error).split())}", file=sys.stderr, flush=True)
    os._exit(1)
