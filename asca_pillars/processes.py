"""One job for each of many items, in processes of their own, with a progress bar."""

import contextlib
import math
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import track

Item = TypeVar("Item")
Result = TypeVar("Result")

# How many threads linear algebra, OpenCV and PyTorch use.
_THREADS = ("OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM", "OMP_NUM_THREADS")
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
    """
    workers = min(workers, math.ceil(len(todo) / at_once))
    with contextlib.ExitStack() as stack:
        if workers > 1:
            stack.enter_context(_one_thread_per_process())
            # Fork would copy the threads of whatever library runs here; a fresh interpreter per worker cannot hang.
            pool = stack.enter_context(multiprocessing.get_context("spawn").Pool(workers, _take_job, (job,)))
            results: Iterator[Result] = pool.imap(_do_job, todo, at_once)
        else:
            results = map(job, todo)
        yield from track(results, title, total=len(todo), console=console, disable=not progress)


def _take_job(job: Callable[[Any], Any]) -> None:
    """In a new process: keep the job. Sent with the items, it would be pickled again with each few of them."""
    global _job
    _job = job


def _do_job(item: Any) -> Any:
    assert _job is not None
    return _job(item)


@contextlib.contextmanager
def _one_thread_per_process() -> Iterator[None]:
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
