"""Jobs in processes: the results of one process, in its order, whatever their number."""

import errno
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from multiprocessing.context import SpawnProcess
from pathlib import Path

import cv2
import pytest

from asca_pillars.base.errors import DatasetError, WorkerError
from asca_pillars.base.processes import map_in_processes


def square(number: int) -> tuple[int, int, int]:
    if number < 0:
        raise DatasetError(f"{number}: is negative")
    if number == 1000:
        raise TwoArgumentsError("one", "second")
    return number * number, os.getpid(), cv2.getNumThreads()


def squares(count: int, workers: int, at_once: int = 4) -> Iterator[tuple[int, int, int]]:
    return map_in_processes(square, range(count), workers, "Squares", at_once=at_once)


def test_results_come_in_order_from_processes_of_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "3")
    monkeypatch.delenv("OPENCV_FOR_THREADS_NUM", raising=False)
    results, processes, threads = zip(*squares(50, 2), strict=True)
    assert results == tuple(number * number for number in range(50)) and set(threads) == {1}
    assert len(set(processes)) in (1, 2) and os.getpid() not in processes  # one may be quicker than the other's start
    assert os.environ["OPENBLAS_NUM_THREADS"] == "3" and "OPENCV_FOR_THREADS_NUM" not in os.environ


@pytest.mark.parametrize(("count", "workers"), [(20, 1), (20, 0), (4, 16), (0, 2)])
def test_nothing_is_started_for_one_process(count: int, workers: int) -> None:
    found = list(squares(count, workers))
    assert [result for result, _, _ in found] == [number * number for number in range(count)]
    assert {process for _, process, _ in found} <= {os.getpid()}


class TwoArgumentsError(Exception):
    """Cannot be unpickled, as the errors of several libraries."""

    def __init__(self, first: str, second: str) -> None:
        super().__init__(first + second)


@pytest.mark.parametrize("workers", [1, 2])
def test_the_error_of_a_job_is_raised(workers: int) -> None:
    results = map_in_processes(square, [3, -1, 2], workers, "Squares", at_once=1)
    assert next(results)[0] == 9
    with pytest.raises(DatasetError, match="-1: is negative"):
        next(results)
    with pytest.raises(TypeError if workers > 1 else TwoArgumentsError, match="second"):
        list(map_in_processes(square, [3, 1000, 2], workers, "Squares", at_once=1))


def unhurried(number: int) -> int:
    time.sleep(0.05 if number else 0)
    return os.getpid()


def test_a_process_that_is_killed_while_it_waits_ends_the_work() -> None:
    """In a pool of the standard library it takes the lock of the common queue with it, and the pool waits forever.

    The kernel kills where memory runs out.
    """
    results = map_in_processes(unhurried, range(1000), 2, "Unhurried", at_once=1)
    process = next(results)
    os.kill(process, signal.SIGKILL)
    deadline = time.monotonic() + 30
    while process in {child.pid for child in multiprocessing.active_children()} and time.monotonic() < deadline:
        time.sleep(0.01)
    with pytest.raises(WorkerError, match=r"1 of 2 worker processes were killed, .*; use fewer workers"):
        list(results)


def test_a_process_that_cannot_be_started_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    class Refused(SpawnProcess):
        def start(self) -> None:
            raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr("multiprocessing.context.SpawnContext.Process", Refused)
    with pytest.raises(WorkerError, match=r"cannot be started .*; use fewer workers"):
        list(squares(50, 2))


def asleep(number: int) -> int:
    os.write(1, f"{os.getpid()}\n".encode())  # at once: two processes write to one pipe
    time.sleep(1)
    return number


MAIN = """
from asca_pillars.base.processes import map_in_processes
from tests.base.test_processes import asleep
if __name__ == "__main__":
    list(map_in_processes(asleep, range(100), 2, "Asleep", at_once=1))
"""


def test_processes_end_with_the_one_that_started_them(tmp_path: Path) -> None:
    (tmp_path / "main.py").write_text(MAIN)
    command = [sys.executable, str(tmp_path / "main.py")]
    path = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=os.environ | {"PYTHONPATH": path}
    ) as main:
        assert main.stdout is not None
        processes: set[int] = set()
        while len(processes) < 2:
            processes.add(int(main.stdout.readline()))
        main.kill()
        main.communicate(timeout=30)  # until the last process that could write there has ended


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


def test_the_job_is_sent_once(tmp_path: Path) -> None:
    job = Noting(tmp_path)
    assert list(map_in_processes(job, range(8), 2, "Noting", at_once=1)) == [*range(8)]
    assert len(list(tmp_path.iterdir())) == 2
