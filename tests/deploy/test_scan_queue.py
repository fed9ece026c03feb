"""Scans that come too fast are dropped and counted, or waited for."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest

from asca_deploy import Detector
from asca_deploy.stream import ScanQueue
from asca_pillars.base.errors import ConfigError, ScanError
from tests.deploy.conftest import make_scan

PATIENCE_S = 20
Start: TypeAlias = Callable[[Callable[[], object]], threading.Thread]


def scan(number: int) -> np.ndarray:
    return np.full((1, 4), number, np.float32)


def numbers(queue: ScanQueue) -> list[int]:
    return [int(points[0, 0]) for points in queue]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts a thread that has to end before the test does."""
    threads: list[threading.Thread] = []

    def begin(target: Callable[[], object]) -> threading.Thread:
        threads.append(threading.Thread(target=target))
        threads[-1].start()
        return threads[-1]

    yield begin
    for thread in threads:
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


def test_the_oldest_waiting_scan_is_dropped_and_counted() -> None:
    queue = ScanQueue("drop", size=2)
    for number in range(5):
        assert queue.put(scan(number), tag=number * 10)
    queue.close()
    assert numbers(queue) == [3, 4]
    assert (queue.dropped, queue.taken) == (3, 2)
    assert [queue.next_tag(), queue.next_tag()] == [30, 40]


def test_waiting_loses_nothing_and_holds_the_sensor_back(start: Start) -> None:
    queue = ScanQueue("wait")
    in_queue: list[int] = []

    def sensor() -> None:
        for number in range(20):
            queue.put(scan(number))
            in_queue.append(number)
        queue.close()

    start(sensor)
    for position, points in enumerate(queue):
        assert int(points[0, 0]) == position
        assert len(in_queue) <= position + 2
    assert (queue.dropped, queue.taken) == (0, 20)


def test_closing_lets_a_waiting_sensor_go(start: Start) -> None:
    queue = ScanQueue("wait")
    queue.put(scan(0))
    answers: list[bool] = []
    waiting = start(lambda: answers.append(queue.put(scan(1))))
    queue.close()
    waiting.join(PATIENCE_S)
    assert answers == [False] and not queue.put(scan(2))
    assert numbers(queue) == [0]


def test_a_stream_that_is_slower_than_the_sensor(tiny_bundle: Path, start: Start) -> None:
    queue, detector = ScanQueue("drop"), Detector(tiny_bundle)
    first = threading.Event()

    def sensor() -> None:
        for number in range(4):
            queue.put(make_scan(number), tag=number)
        assert first.wait(PATIENCE_S)  # the detector has begun; what came too fast is gone
        for number in range(4, 40):
            queue.put(make_scan(number), tag=number)
        queue.close()

    start(sensor)
    tags = []
    for detections in detector.stream(queue):
        first.set()
        tags.append(queue.next_tag())
        alone = detector(make_scan(tags[-1]))
        assert np.array_equal(detections.boxes, alone.boxes), "the tag is that of the scan"
    assert tags == sorted(tags) and tags[-1] == 39, "the latest scan is never the one that is dropped"
    assert len(tags) == queue.taken and queue.taken + queue.dropped == 40


def test_a_stream_after_one_that_failed_has_the_tags_of_its_own_scans(tiny_bundle: Path) -> None:
    queue, detector = ScanQueue("wait", size=5), Detector(tiny_bundle)
    for number in range(5):
        queue.put(make_scan(number)[:, : 3 if number == 1 else 4], tag=number)
    queue.close()
    tags: list[int] = []
    with pytest.raises(ScanError):
        tags.extend(queue.next_tag() for _ in detector.stream(queue))
    for detections in detector.stream(queue):
        tags.append(queue.next_tag())
        assert np.array_equal(detections.boxes, detector(make_scan(tags[-1])).boxes)
    assert tags == [0, 2, 3, 4]


def test_tags_keep_their_places_among_scans_without_and_those_leave_nothing_behind() -> None:
    queue = ScanQueue("wait", size=2000)
    for number in range(2000):
        queue.put(scan(number), tag=number if number % 500 == 1 else None)
    queue.close()
    assert len(numbers(queue)) == 2000
    assert len(queue._tags) == 4
    assert [queue.next_tag() for _ in range(2000)] == [n if n % 500 == 1 else None for n in range(2000)]
    with pytest.raises(IndexError, match="once for each result"):
        queue.next_tag()


@pytest.mark.parametrize("way", ["left", "error"])
def test_a_stream_over_a_silent_sensor_can_be_left(tiny_bundle: Path, start: Start, way: str) -> None:
    """The sensor stops without a word; leaving the loop does not wait for it, and a new stream goes on."""
    queue, detector = ScanQueue("wait", size=3), Detector(tiny_bundle)
    for number in range(2):
        queue.put(make_scan(number), tag=number)
    left = threading.Event()

    def drive() -> None:
        with contextlib.suppress(KeyboardInterrupt):
            for _ in detector.stream(queue):
                if way == "left":
                    break
                raise KeyboardInterrupt
        left.set()

    start(drive)
    assert left.wait(PATIENCE_S)
    queue.put(make_scan(2), tag=2)
    queue.close()
    assert [queue.next_tag() for _ in detector.stream(queue)][-1] == 2


def test_impossible_wishes() -> None:
    with pytest.raises(ConfigError, match="when_full block: give drop or wait"):
        ScanQueue("block")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="size 0"):
        ScanQueue("drop", size=0)
    with pytest.raises(IndexError):
        ScanQueue("drop").next_tag()
