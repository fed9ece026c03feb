"""Pipelining of scans: one in the network, the next being prepared, the one before being decoded.

    caller      decode 1 | decode 2 | decode 3        boxes are handed out
    network       net 2  |  net 3   |  net 4
    host         scan 3  | scan 4   | scan 5          read, and prepared on memory of its own

More scans per second are processed than one after the other, each with a little more latency.

`ScanQueue` brings scans from a sensor's thread to a detector:

    queue = ScanQueue(when_full="drop")
    lidar.on_scan = queue.put            # in the sensor's thread
    for detections in detector.stream(queue):
        ...
    print(queue.dropped)
"""

import atexit
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future
from queue import SimpleQueue
from typing import Any, Generic, Literal, TypeAlias, TypeVar, get_args

from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError

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
    called first and lets its iterator end (`ScanQueue`). A program that ends with an open stream waits for
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
            outputs = current.result()
            if not outputs:
                return
            yield finish(outputs[0])


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
                    future.set_result(() if self._left else tuple(self._infer(prepared) for prepared in ready))
            except BaseException as error:
                future.set_exception(error)
            del item, future, ready


_open: set[_StageThreads[Any, Any, Any]] = set()


@atexit.register
def _leave_open() -> None:
    for stream in tuple(_open):
        stream.leave()


WhenFull: TypeAlias = Literal["drop", "wait"]


class ScanQueue:
    """Queue between a sensor's thread, which calls `put`, and `Detector.stream`, which iterates. One of each.

    A stream takes up to two scans ahead of the one that it hands out; those are no longer in the queue. After a stream
    that failed or was left, a new one over the same queue continues with the waiting scans.

    Args:
        when_full: what a scan does that finds the queue full. "drop": the oldest waiting scan is dropped and counted,
            so that boxes are of the latest scans. "wait": `put` waits until there is room, so that none is lost.
        size: scans that may wait.

    Attributes:
        dropped: how many scans were dropped.
        taken: how many were handed to the iterator.

    Raises:
        ConfigError: another word than these two, or a size below 1.
    """

    def __init__(self, when_full: WhenFull, size: int = 1) -> None:
        if when_full not in get_args(WhenFull):
            raise ConfigError(f"when_full {when_full}: give {' or '.join(get_args(WhenFull))}")
        if size < 1:
            raise ConfigError(f"size {size}: must be at least 1")
        self._drops, self._size = when_full == "drop", size
        self._waiting: deque[tuple[NDArray[Any], Any]] = deque()
        self._tags: dict[int, Any] = {}  # by the number of the scan; a scan without a tag leaves nothing to be kept
        self._next = 0  # the scan whose tag is asked for next, counted as `taken`
        self._changed = threading.Condition()
        self._closed = False
        self._stream = 0  # number of the iterator that gets the scans; iterators of other numbers end
        self.dropped = self.taken = 0

    def put(self, points: NDArray[Any], tag: Any = None) -> bool:
        """Put a scan into the queue; return False only if the queue was closed.

        Args:
            points: (N, 4) as for `Detector`, x, y, z in metres and reflectance; not to be written to afterwards.
            tag: what shall come back with the detections, such as the time stamp: see `next_tag`.
        """
        with self._changed:
            if not self._drops:
                self._changed.wait_for(lambda: self._closed or len(self._waiting) < self._size)
            if self._closed:
                return False
            if len(self._waiting) == self._size:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append((points, tag))
            self._changed.notify_all()
            return True

    def close(self) -> None:
        """Close the queue: waiting scans are handed out, then the iterator ends. `put` returns False from here on."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def interrupt(self) -> None:
        """End the current iterator; waiting scans stay for the next one. A stream that is closed calls it."""
        with self._changed:
            self._stream += 1
            self._changed.notify_all()

    def next_tag(self) -> Any:
        """Return the tag of the oldest scan that was handed out: call it once for each result of the stream.

        None for a scan that was put without one, so that scans with and without tags keep their places. Tags that are
        never asked for are kept until the next stream begins; it starts with its own first scan.

        Raises:
            IndexError: it was called more often than scans were handed out.
        """
        with self._changed:
            if self._next == self.taken:
                raise IndexError("next_tag: no scan was handed out since the last call; call it once for each result")
            number, self._next = self._next, self._next + 1
            return self._tags.pop(number, None)

    def __iter__(self) -> Iterator[NDArray[Any]]:
        with self._changed:
            # Scans that an earlier stream took and never handed out have no result that could ask for their tags.
            self._tags.clear()
            self._next = self.taken
            self._stream += 1
            return self._scans(self._stream)

    def _scans(self, stream: int) -> Iterator[NDArray[Any]]:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._waiting or self._stream != stream)
                if not self._waiting or self._stream != stream:
                    return
                points, tag = self._waiting.popleft()
                if tag is not None:
                    self._tags[self.taken] = tag
                self.taken += 1
                self._changed.notify_all()
            yield points
