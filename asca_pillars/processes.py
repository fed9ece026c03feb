"""One job for each of many items, in processes of their own, with a progress bar."""

import contextlib
import math
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import track

from asca_pillars.errors import WorkerError

Item = TypeVar("Item")
Result = TypeVar("Result")

# How many threads linear algebra, OpenCV and PyTorch use.
_THREADS = ("OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM", "OMP_NUM_THREADS")
_LOOK_AGAIN_S = 1.0
_job: Callable[[Any], Any] | None = None


def in_processes(
    job: Callable[[Item], Result],
    todo: Sequence[Item],
    workers: int,
    title: str,
    *,
    at_once: int = 4,
    progress: bool = True,
    console: Console | None = None,
) -> Iterator[Result]:
    """The results of a job for each item, in the order of the items, each as soon as it is there.

    Args:
        job: one that can be sent to a process, if more than one works.
        todo: the items.
        workers: processes; with one, or with so few items that a second would get none, the job is done in this one.
        title: of the progress bar.
        at_once: items that a process takes at a time.
        progress: whether it is shown.
        console: where; on standard output if None.

    Raises:
        Exception: that of the job.
        WorkerError: a process was killed.
    """
    workers = min(workers, math.ceil(len(todo) / at_once))
    with contextlib.ExitStack() as stack:
        if workers > 1:
            stack.enter_context(one_thread_per_process())
            others = {process.pid for process in multiprocessing.active_children()}
            # Fork would copy the threads of whatever library runs here; a fresh interpreter per worker cannot hang.
            pool = stack.enter_context(multiprocessing.get_context("spawn").Pool(workers, _take_job, (job,)))
            own = {process.pid for process in multiprocessing.active_children()} - others
            shares = (todo[first : first + at_once] for first in range(0, len(todo), at_once))
            results = _while_all_live(pool.imap(_do_job, shares), own)
        else:
            results = map(job, todo)
        yield from track(results, title, total=len(todo), console=console, disable=not progress)


def _while_all_live(shares: Any, processes: set[int | None]) -> Iterator[Any]:
    """The results of `pool.imap`, which waits forever for those of a process that was killed."""
    while True:
        try:
            yield from shares.next(timeout=_LOOK_AGAIN_S)
        except StopIteration:
            return
        except multiprocessing.TimeoutError:
            if dead := processes - {process.pid for process in multiprocessing.active_children()}:
                raise WorkerError(
                    f"{len(dead)} of {len(processes)} worker processes were killed, perhaps for want of memory; "
                    "use fewer workers"
                ) from None


def _take_job(job: Callable[[Any], Any]) -> None:
    """In a new process: keep the job. Sent with the items, it would be pickled again with each few of them."""
    global _job
    _job = job


def _do_job(items: Sequence[Any]) -> list[Any]:
    assert _job is not None
    return [_job(item) for item in items]


@contextlib.contextmanager
def one_thread_per_process() -> Iterator[None]:
    """The processes started inside compute with one thread each: the processes are the parallelism."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
