"""The processes that load batches: forked from a server that has imported, once, what all of them need."""

import multiprocessing
import signal
from multiprocessing.context import ForkServerContext


def loader_context() -> ForkServerContext:
    """How `DataLoader` starts its processes.

    Each process would import torch for itself otherwise: seconds of start, and hundreds of MiB that are shared now.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["asca_pillars.training.dataset", __name__])
    return context


def leave_interrupts_to_the_loop(_: int) -> None:
    """Ctrl-C reaches every process of the terminal, SIGTERM of a batch system every one of the job.

    A step that is under way still needs its batch. A second SIGTERM ends the process: it is the loader's own.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: signal.signal(signal.SIGTERM, signal.SIG_DFL) and None)
