"""Jobs in processes: the results of one process, in its order, whatever their number."""

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest

from asca_pillars.errors import DatasetError, WorkerError
from asca_pillars.processes import in_processes


def square(number: int) -> tuple[int, int, int]:
    if number < 0:
        raise DatasetError(f"{number}: is negative")
    return number * number, os.getpid(), cv2.getNumThreads()


def squares(count: int, workers: int, at_once: int = 4) -> Iterator[tuple[int, int, int]]:
    return in_processes(square, range(count), workers, "Squares", at_once=at_once, progress=False)


def test_results_come_in_order_from_processes_of_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "3")
    monkeypatch.delenv("OPENCV_FOR_THREADS_NUM", raising=False)
    found = list(squares(50, 2))
    assert [result for result, _, _ in found] == [number * number for number in range(50)]
    processes = {process for _, process, _ in found}
    assert len(processes) in (1, 2) and os.getpid() not in processes  # one may be quicker than the other's start
    assert {threads for _, _, threads in found} == {1}
    assert os.environ["OPENBLAS_NUM_THREADS"] == "3" and "OPENCV_FOR_THREADS_NUM" not in os.environ


@pytest.mark.parametrize(("count", "workers"), [(20, 1), (20, 0), (4, 16), (0, 2)])
def test_nothing_is_started_for_one_process(count: int, workers: int) -> None:
    found = list(squares(count, workers))
    assert [result for result, _, _ in found] == [number * number for number in range(count)]
    assert {process for _, process, _ in found} <= {os.getpid()}


@pytest.mark.parametrize("workers", [1, 2])
def test_the_error_of_a_job_is_raised(workers: int) -> None:
    results = in_processes(square, [3, -1, 2], workers, "Squares", at_once=1, progress=False)
    assert next(results)[0] == 9
    with pytest.raises(DatasetError, match="-1: is negative"):
        next(results)


def killed(number: int) -> int:
    if number == 5:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def test_a_process_that_is_killed_ends_the_work() -> None:
    """The kernel does that where memory runs out; the pool of the standard library then waits forever."""
    results = in_processes(killed, range(40), 2, "Killed", progress=False)
    with pytest.raises(WorkerError, match=r"1 of 2 worker processes were killed, .*; use fewer workers"):
        list(results)


def test_the_job_is_sent_once(tmp_path: Path) -> None:
    job = Noting(tmp_path)
    assert list(in_processes(job, range(8), 2, "Noting", at_once=1, progress=False)) == [0, 1, 2, 3, 4, 5, 6, 7]
    assert len(list(tmp_path.iterdir())) == 2


class Noting:
    """A job that leaves a file where it is unpickled."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __call__(self, item: int) -> int:
        deadline = time.monotonic() + 60
        while len(list(self.folder.iterdir())) < 2 and time.monotonic() < deadline:  # one may start after the other
            time.sleep(0.01)
        return item

    def __reduce__(self) -> tuple[object, ...]:
        return noted, (self.folder,)


def noted(folder: Path) -> Noting:
    (folder / str(os.getpid())).touch(exist_ok=False)
    return Noting(folder)
