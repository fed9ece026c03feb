"""Pipelining of scans: one in the network, the next being prepared, the one before being decoded.

    caller      decode 1 | decode 2 | decode 3        boxes are handed out
    network       net 2  |  net 3   |  net 4
    host         scan 3  | scan 4   | scan 5          read, and prepared on memory of its own

More scans per second are processed than one after the other, each with a little more latency.
"""

import atexit
import sys
import threading
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future
from queue import SimpleQueue
from typing import Any, Generic, TypeVar

Scan = TypeVar("Scan")
Ready = TypeVar("Ready")
Maps = TypeVar("Maps")
Result = TypeVar("Result")


def overlap_stages(
    scans: Iterable[Scan],
    prepare: Callable[[Scan], Ready],
    infer: Callable[[Ready], Maps],
    finish: Callable[[Maps], Result],
) -> Generator[Result, None, None]:
    """Yield `finish(infer(prepare(scan)))` of each scan, in order; the three run concurrently on different scans.

    `scans` is read in a thread of its own, so that reading files or waiting for a sensor overlaps too, and never more
    than one scan ahead of the one that is asked for. Closing the iterator waits for the stages that run, and for the
    scan if one is being read, and ends both threads. A source that may block forever has a method `interrupt`, which is
    called first and lets its iterator end (`scan_queue.ScanQueue`). A program that ends with an open stream waits for
    the stages that run and for no scan.

    Args:
        scans: read in the host's thread.
        prepare: runs in the host's thread, at most one scan ahead of `infer`.
        infer: runs in the network's thread.
        finish: runs in the caller's thread.

    Raises:
        Exception: whatever `scans` or a stage raises, in the place of the scan it belongs to; it ends the iterator.
    """
    with _StageThreads(scans, prepare, infer) as ahead:
        coming = ahead.start()
        while True:
            current, coming = coming, ahead.start()
            found = current.result()
            if not found:
                return
            yield finish(found[0])


class _StageThreads(Generic[Scan, Ready, Maps]):
    """Two daemon threads, one for `prepare` and one for `infer`.

    Daemons, because the interpreter joins other threads before `atexit` functions run, and a source that blocks could
    then not be interrupted.
    """

    def __init__(self, scans: Iterable[Scan], prepare: Callable[[Scan], Ready], infer: Callable[[Ready], Maps]) -> None:
        self._source, self._scans = scans, iter(scans)
        self._prepare, self._infer = prepare, infer
        self._ended = self._left = False
        self._asked: SimpleQueue[Future[tuple[Maps, ...]] | None] = SimpleQueue()
        self._ready: SimpleQueue[tuple[Future[tuple[Maps, ...]], tuple[Ready, ...]] | None] = SimpleQueue()
        self._preparing, self._inferring = threading.Lock(), threading.Lock()
        self._host = threading.Thread(target=self._run_host, name="asca-host", daemon=True)
        self._network = threading.Thread(target=self._run_network, name="asca-network", daemon=True)

    def __enter__(self) -> "_StageThreads[Scan, Ready, Maps]":
        self._host.start()
        self._network.start()
        _open.add(self)
        return self

    def __exit__(self, *_: object) -> None:
        if sys.is_finalizing():  # daemons stand still by now and cannot be joined; `leave` was called before
            return
        _open.discard(self)
        self.leave()
        self._asked.put(None)
        self._host.join()
        self._network.join()

    def start(self) -> "Future[tuple[Maps, ...]]":
        """Begin with the next scan; the future's result is empty if there is no scan left."""
        future: Future[tuple[Maps, ...]] = Future()
        self._asked.put(future)
        return future

    def leave(self) -> None:
        """Start no further stages and wait for those that run, as libraries are unloaded at exit."""
        self._left = True
        interrupt = getattr(self._source, "interrupt", None)
        if interrupt is not None:
            interrupt()
        for thread, running in ((self._host, self._preparing), (self._network, self._inferring)):
            if thread.is_alive():  # not so in a forked process, where nobody would release the lock
                with running:
                    pass

    def _run_host(self) -> None:
        while (future := self._asked.get()) is not None:
            try:
                ready = self._next_ready()
            except BaseException as error:
                future.set_exception(error)
            else:
                self._ready.put((future, ready))
                del ready
            del future  # the thread keeps nothing of a scan while it waits for the next one
        self._ready.put(None)

    def _next_ready(self) -> tuple[Ready, ...]:
        if self._ended or self._left:
            return ()
        self._ended = True  # stays so if reading or preparing fails: what comes after would never be handed out
        try:
            scan = next(self._scans)
        except StopIteration:
            return ()
        with self._preparing:
            if self._left:
                return ()
            ready = self._prepare(scan)
        self._ended = False
        return (ready,)

    def _run_network(self) -> None:
        while (item := self._ready.get()) is not None:
            future, ready = item
            try:
                with self._inferring:
                    future.set_result(() if self._left else tuple(self._infer(one) for one in ready))
            except BaseException as error:
                future.set_exception(error)
            del item, future, ready


_open: set[_StageThreads[Any, Any, Any]] = set()


@atexit.register
def _leave_open() -> None:
    for stream in tuple(_open):
        stream.leave()
