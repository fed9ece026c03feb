"""Parallel execution of a job for many items in processes."""

import contextlib
import math
import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple, TypeVar

from asca_pillars.base.errors import AscaError, WorkerError
from asca_pillars.base.progress import SILENT, Reporter

Item = TypeVar("Item")
Result = TypeVar("Result")

# How many threads linear algebra, OpenCV and PyTorch use.
_THREADS = ("OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM", "OMP_NUM_THREADS")


def map_in_processes(
    job: Callable[[Item], Result],
    todo: Sequence[Item],
    workers: int,
    title: str,
    *,
    at_once: int = 4,
    reporter: Reporter = SILENT,
) -> Iterator[Result]:
    """Yield the results of a job for each item, in the order of the items, each as soon as it is there.

    Args:
        job: one that can be sent to a process, if more than one works.
        todo: the items.
        workers: processes; with one, or with so few items that a second would get none, the job is done in this one.
        title: name of the step for the progress.
        at_once: items that a process takes at a time.
        reporter: for the progress.

    Raises:
        Exception: that of the job.
        WorkerError: a process was killed, or cannot be started.
    """
    workers = min(workers, math.ceil(len(todo) / at_once))
    with contextlib.ExitStack() as stack:
        if workers > 1:
            pool = stack.enter_context(_pool(job, workers))
            results = _ordered_results(todo, at_once, pool)
        else:
            results = map(job, todo)
        yield from reporter.track(results, title, len(todo))


_Pool = dict[Any, BaseProcess]
"""Processes by the pipe (`Connection`) that each has of its own.

The pools of the standard library have queues in common, whose locks a process takes with it when it is killed: the
others, and the one that started them, then wait forever.
"""


class _Failed(NamedTuple):
    """Error of a job, in the place of its result."""

    error: Exception


@contextlib.contextmanager
def _pool(job: Callable[[Any], Any], workers: int) -> Iterator[_Pool]:
    """Start processes that run a job on the items sent to them, until the block ends.

    Raises:
        WorkerError: one cannot be started.
    """
    # Fork would copy the threads of whatever library runs here; a fresh interpreter per worker cannot hang.
    context = multiprocessing.get_context("spawn")
    pool: _Pool = {}
    try:
        try:
            with one_thread_per_process():
                for _ in range(workers):
                    parent_end, child_end = context.Pipe()
                    with child_end:
                        process: BaseProcess = context.Process(target=_work, args=(job, child_end), daemon=True)
                        process.start()
                    pool[parent_end] = process
        except OSError as error:
            raise WorkerError(f"a worker process cannot be started ({error}); use fewer workers") from None
        yield pool
    finally:
        for connection, process in pool.items():
            connection.close()
            process.kill()  # it waits for items, or nobody waits for what it does
        for process in pool.values():
            process.join()


def _ordered_results(todo: Sequence[Any], at_once: int, pool: _Pool) -> Iterator[Any]:
    """Yield the results of the items in their order.

    Raises:
        Exception: that of the job.
        WorkerError: a process was killed.
    """
    starts = iter(range(0, len(todo), at_once))
    at: dict[Any, int] = {}  # the first item of what each process is at
    done: dict[int, list[Any]] = {}
    for next_index in range(0, len(todo), at_once):
        while next_index not in done:
            try:
                for connection in pool.keys() - at.keys():
                    if (start := next(starts, None)) is not None:
                        connection.send(todo[start : start + at_once])
                        at[connection] = start
                ready: list[Any] = wait(list(at))
                for connection in ready:
                    done[at.pop(connection)] = connection.recv()
            except (EOFError, ConnectionError):
                dead = sum(process.exitcode is not None for process in pool.values()) or 1
                raise WorkerError(
                    f"{dead} of {len(pool)} worker processes were killed, perhaps because memory ran out; "
                    "use fewer workers"
                ) from None
        for result in done.pop(next_index):
            if isinstance(result, _Failed):
                raise result.error
            yield result


def _work(job: Callable[[Any], Any], connection: Connection) -> None:
    """Run the job in a new process for the items received, until the connection ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches it, too; the process that started it ends it
    with contextlib.suppress(EOFError, ConnectionError):  # the other process has ended
        while True:
            connection.send(_results(job, connection.recv()))


def _results(job: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
    results: list[Any] = []
    for item in items:
        try:
            results.append(job(item))
        except Exception as error:
            if not isinstance(error, AscaError):
                error.add_note(traceback.format_exc())
            return [*results, _Failed(error)]
    return results


@contextlib.contextmanager
def one_thread_per_process() -> Iterator[None]:
    """Let the processes started inside the block compute with one thread each, as they run in parallel."""
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
