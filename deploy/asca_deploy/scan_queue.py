"""Queue of scans from a sensor's thread to a detector.

queue = ScanQueue(when_full="drop")
lidar.on_scan = queue.put            # in the sensor's thread
for detections in detector.stream(queue):
    ...
print(queue.dropped)
"""

import threading
from collections import deque
from collections.abc import Iterator
from typing import Any, Literal, TypeAlias, get_args

from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError

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
            raise ConfigError(f"size {size}: at least one scan has to wait somewhere")
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
