"""Scans per second of `Detector.stream`, and its latency for a single scan."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle, islice
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from asca_deploy.benchmark.timing import Percentiles, Spread, Track, run_frame, silently
from asca_deploy.detector import Detector

FRAMES = 8  # minimum of a round


@dataclass(frozen=True)
class Throughput:
    """Scan after scan, one by one and as a stream."""

    single_latency_ms: Percentiles
    stream_latency_ms: Percentiles
    """Time from the points to the boxes, including the wait for the scan before."""
    single_fps: float
    """Scans per second that are finished, median over the rounds."""
    stream_fps: float
    gain: Spread
    """stream / single, over the rounds."""
    rounds: int


def measure_throughput(
    detector: Detector, scans: Sequence[NDArray[np.float32]], rounds: int = 10, track: Track = silently
) -> Throughput:
    """Time passes over `scans`, (N, 4) each, LiDAR frame, one by one and streamed in turn."""
    frames = list(islice(cycle(scans), max(FRAMES, len(scans))))
    single_ms: list[float] = []
    stream_ms: list[float] = []
    rates = np.empty((rounds, 2))
    for number in track(rounds, "streaming"):
        start = perf_counter()
        single_ms += [run_frame(detector, scan).total_ms for scan in frames]
        rates[number, 0] = len(frames) / (perf_counter() - start)
        results = detector.stream([frames[0], *frames])
        next(results)  # the pipeline is full when the clock starts
        start = perf_counter()
        stream_ms += [detections.report.total_ms for detections in results]
        rates[number, 1] = len(frames) / (perf_counter() - start)
    single, stream = np.median(rates, axis=0)
    return Throughput(
        Percentiles.of(single_ms),
        Percentiles.of(stream_ms),
        float(single),
        float(stream),
        Spread.of(rates[:, 1] / rates[:, 0]),
        rounds,
    )
