import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_deploy import Detector
from asca_deploy.pillar.pipeline import DenseBackbone, PillarPipeline
from asca_deploy.stream import overlap_stages
from asca_pillars.base.errors import ScanError
from tests.deploy.conftest import make_scan
from tests.helpers.same_detections import same

Points = NDArray[np.float32]
PATIENCE_S = 20  # only a test that fails waits so long


def stage_threads() -> int:
    """Threads of streams alone: those of detectors that other tests opened end when they are collected."""
    return sum(thread.name.startswith("asca-") for thread in threading.enumerate())


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> Iterator[None]:
    yield
    assert stage_threads() == 0


def test_the_same_boxes_and_counters_as_one_by_one(tiny_bundle: Path) -> None:
    scans = [make_scan(seed, count) for seed, count in enumerate((1000, 0, 200, 1, 1000, 900, 30))]
    detector, alone, other = Detector(tiny_bundle), Detector(tiny_bundle), make_scan(7)
    streamed = 0
    for points, detections in zip(scans, detector.stream(iter(scans)), strict=True):
        expected = alone(points)
        assert same(detections, expected)
        assert detections.report.counts == expected.report.counts
        assert detections.report.warnings == expected.report.warnings
        assert same(detector(other), alone(other)), "a call between two scans of the stream disturbs neither"
        streamed += len(detections)
    assert streamed > 10


def test_latency_includes_the_waiting(tiny_bundle: Path, scans: list[Points]) -> None:
    detector = Detector(tiny_bundle)
    for detections in detector.stream(scans):
        frame = detections.report
        assert all(time_ms > 0 for time_ms in frame.times_ms.values())
        assert frame.waiting_ms > 0
        assert frame.total_ms == pytest.approx(sum(frame.times_ms.values()) + frame.waiting_ms)
    assert detector(scans[0]).report.waiting_ms == 0


def test_never_more_than_one_scan_ahead(tiny_bundle: Path) -> None:
    read: list[int] = []

    def source() -> Iterator[Points]:
        for number in range(6):
            read.append(number)
            yield make_scan(number)

    results = Detector(tiny_bundle).stream(source())
    assert read == []
    for number, _ in enumerate(results):
        assert len(read) <= number + 2
    assert read == list(range(6))


def test_a_slow_source_does_not_hold_back_what_is_done(tiny_bundle: Path, scan: Points) -> None:
    arrived = threading.Event()

    def sensor() -> Iterator[Points]:
        yield scan
        assert arrived.wait(PATIENCE_S)
        yield scan

    results = Detector(tiny_bundle).stream(sensor())
    assert len(next(results)) > 0  # although the next scan is not there yet
    arrived.set()
    assert len(list(results)) == 1


@pytest.mark.parametrize("cause", ["source", "shape"])
def test_an_error_comes_in_its_place(tiny_bundle: Path, scan: Points, cause: str) -> None:
    def source() -> Iterator[Points]:
        yield from (scan, scan)
        if cause == "source":
            raise OSError("unplugged")
        yield scan[:, :3]
        yield scan

    detector = Detector(tiny_bundle)
    results = detector.stream(source())
    expected = detector(scan)
    assert same(next(results), expected) and same(next(results), expected)
    with pytest.raises(OSError if cause == "source" else ScanError, match=r"unplugged|not \(N, 4\)"):
        next(results)
    assert list(results) == [] == list(detector.stream([]))
    assert same(detector(scan), expected)


@pytest.mark.parametrize("stage", ["infer", "finish"])
def test_a_stage_that_fails_ends_the_stream_there(
    tiny_bundle: Path, scan: Points, monkeypatch: pytest.MonkeyPatch, stage: str
) -> None:
    detector = Detector(tiny_bundle)
    works: Callable[..., object] = getattr(detector.pipeline, stage)
    calls: list[int] = []

    def fails_the_second_time(*arguments: object) -> object:
        calls.append(1)
        if len(calls) == 2:
            raise RuntimeError("broken")
        return works(*arguments)

    monkeypatch.setattr(detector.pipeline, stage, fails_the_second_time)
    results = detector.stream([scan] * 4)
    next(results)
    with pytest.raises(RuntimeError, match="broken"):
        next(results)
    monkeypatch.undo()
    assert len(detector(scan)) > 0


def test_closing_early_ends_the_threads_and_spoils_nothing(tiny_bundle: Path, scans: list[Points]) -> None:
    detector = Detector(tiny_bundle)
    expected = detector(scans[0])
    results = detector.stream(scans * 20)
    next(results)
    assert threading.active_count() > 1
    results.close()
    assert list(results) == []
    assert same(detector(scans[0]), expected)


def test_nothing_grows_with_the_number_of_scans(tiny_bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    detector, scans = Detector(tiny_bundle), [make_scan(seed, 50 + 20 * seed) for seed in range(5)]
    images: set[int] = set()
    assert isinstance(detector.pipeline, PillarPipeline)
    backbone = detector.pipeline.backbone
    assert isinstance(backbone, DenseBackbone)
    neck_and_head = backbone.neck_and_head
    monkeypatch.setattr(backbone, "neck_and_head", lambda image: images.add(image.ctypes.data) or neck_and_head(image))
    most_threads = 0
    for _ in detector.stream(scans[number % 5] for number in range(300)):
        most_threads = max(most_threads, stage_threads())
    assert len(images) <= 2
    assert most_threads == 2


def test_stop_iteration_out_of_a_stage_is_an_error_and_no_end() -> None:
    def prepare(scan: int) -> int:
        raise StopIteration(scan)

    with pytest.raises(RuntimeError):
        list(overlap_stages([1, 2], prepare, infer=lambda ready: ready, finish=lambda found: found))


LEFT = """
import sys, threading
from asca_deploy.stream import ScanQueue
from asca_deploy.stream import overlap_stages

def silent():
    yield 1
    threading.Event().wait()

way, queue = sys.argv[1], ScanQueue("wait")
queue.put(1)
scans = silent() if way == "no interrupt" else queue
stream = overlap_stages(scans, prepare=lambda scan: scan, infer=lambda ready: ready, finish=lambda found: found)

def callback(found):
    if way == "raise":
        raise ValueError("callback failed")

callback(next(stream))
print("end of program")
"""

BUSY = """
import threading, time
from asca_deploy.stream import overlap_stages

begun = threading.Event()

def infer(ready):
    if ready == 2:
        begun.set()
        time.sleep(0.5)
        print("inferred", flush=True)
    return ready

stream = overlap_stages([1, 2], prepare=lambda scan: scan, infer=infer, finish=lambda found: found)
next(stream)
begun.wait()
"""


def run_program(text: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", text, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=6 * PATIENCE_S)


@pytest.mark.parametrize(("way", "status"), [("leave", 0), ("raise", 1), ("no interrupt", 0)])
def test_a_program_that_leaves_a_stream_over_a_silent_sensor_ends(way: str, status: int) -> None:
    """The stream is still held: by a variable, or by the frame of the traceback."""
    ended = run_program(LEFT, way)
    assert ended.returncode == status
    assert ("end of program" in ended.stdout) == (status == 0)
    assert ("ValueError: callback failed" in ended.stderr) == (status == 1)


def test_a_program_that_ends_waits_for_the_stage_that_runs() -> None:
    ended = run_program(BUSY)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "inferred\n", "")
