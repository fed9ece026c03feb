"""Scan after scan with the network never waiting: one scan in it, the next on its way to it, the one before decoded.

    caller      decode 1 | decode 2 | decode 3        boxes are handed out
    network       net 2  |  net 3   |  net 4
    host         scan 3  | scan 4   | scan 5          read, and prepared on memory of its own

There are more scans per second than one after the other, and each is a little later, for it waits for the one before.
"""

from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

Scan = TypeVar("Scan")
Ready = TypeVar("Ready")
Maps = TypeVar("Maps")
Result = TypeVar("Result")


def overlapped(
    scans: Iterable[Scan],
    prepare: Callable[[Scan], Ready],
    infer: Callable[[Ready], Maps],
    finish: Callable[[Maps], Result],
) -> Generator[Result, None, None]:
    """`finish(infer(prepare(scan)))` of each scan, in order; the three run at once, for different scans.

    `scans` is read in a thread of its own, so that reading files or waiting for a sensor overlaps too, and never more
    than one scan ahead of the one that is asked for. Closing the iterator waits for the stages that run, and for the
    scan if one is being read, and ends both threads. A source that may wait for ever has a method `interrupt`, which is
    called first and lets its iterator end (`scan_queue.ScanQueue`).

    Args:
        scans: read in the host's thread.
        prepare: runs in the host's thread, at most one scan ahead of `infer`.
        infer: runs in the network's thread.
        finish: runs in the caller's thread.

    Raises:
        Exception: whatever `scans` or a stage raises, in the place of the scan it belongs to; it ends the iterator.
    """
    with _Ahead(scans, prepare, infer) as ahead:
        coming = ahead.start()
        while True:
            current, coming = coming, ahead.start()
            found = current.result()
            if not found:
                return
            yield finish(found[0])


class _Ahead(Generic[Scan, Ready, Maps]):
    """Two threads, each of which does its own stage of scan after scan."""

    def __init__(self, scans: Iterable[Scan], prepare: Callable[[Scan], Ready], infer: Callable[[Ready], Maps]) -> None:
        self._source, self._scans = scans, iter(scans)
        self._prepare, self._infer = prepare, infer
        self._ended = False
        self._host = ThreadPoolExecutor(1, "asca-host")
        self._network = ThreadPoolExecutor(1, "asca-network")

    def __enter__(self) -> "_Ahead[Scan, Ready, Maps]":
        return self

    def __exit__(self, *_: object) -> None:
        interrupt = getattr(self._source, "interrupt", None)
        if interrupt is not None:
            interrupt()
        # The host first: the network's thread may be waiting for it.
        self._host.shutdown(cancel_futures=True)
        self._network.shutdown(cancel_futures=True)

    def start(self) -> "Future[tuple[Maps, ...]]":
        """Begin with the next scan; the future holds what `infer` makes of it, or nothing if there is no scan left."""
        return self._network.submit(self._run_network, self._host.submit(self._run_host))

    def _run_host(self) -> tuple[Ready, ...]:
        if self._ended:
            return ()
        self._ended = True  # stays so if reading or preparing fails: what comes after would never be handed out
        try:
            scan = next(self._scans)
        except StopIteration:
            return ()
        ready = self._prepare(scan)
        self._ended = False
        return (ready,)

    def _run_network(self, coming: "Future[tuple[Ready, ...]]") -> tuple[Maps, ...]:
        return tuple(self._infer(ready) for ready in coming.result())
