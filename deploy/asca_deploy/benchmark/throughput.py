"""Scans per second of `Detector.stream`, and its latency for a single scan.

Time of each stage as a function of the number of points.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle, islice
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from asca_deploy.benchmark.timing import Percentiles, Spread, Track, pillars_of, run_frame, silently
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


COUNTS = (1_000, 10_000, 100_000, 1_000_000)
JITTER_M = 0.02  # similar to a LiDAR's range noise


@dataclass(frozen=True)
class ScalingRow:
    """One number of points."""

    points: int
    pillars: int
    """Pillars after the limits, the mean of the passes."""
    stages_ms: dict[str, float]
    """p50 of each stage."""
    total_ms: float
    """p50 of the whole."""


def measure_scaling(
    detector: Detector,
    scan: NDArray[np.float32],
    counts: Sequence[int] = COUNTS,
    rounds: int = 10,
    track: Track = silently,
) -> tuple[ScalingRow, ...]:
    """Time the detector on `scan` (N, 4), LiDAR frame, with fewer and more points; the sizes take turns."""
    scans = [resample(scan, count) for count in counts]
    for points in scans:
        detector(points)
    frames = [[run_frame(detector, points) for points in scans] for _ in track(rounds, "scaling")]
    return tuple(
        ScalingRow(
            points=len(points),
            pillars=pillars_of(column[0]),
            stages_ms={stage: float(np.median([f.times_ms[stage] for f in column])) for stage in column[0].times_ms},
            total_ms=float(np.median([f.total_ms for f in column])),
        )
        for points, column in zip(scans, zip(*frames, strict=True), strict=True)
    )


def resample(scan: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """Return `count` points of a scan (N, 4) in random order; beyond N, points again with a sensor's noise on x, y, z.

    Raises:
        ValueError: the scan has no point.
    """
    if not len(scan):
        raise ValueError("a scan without points cannot be resampled")
    rng = np.random.default_rng(0)
    extra = scan[rng.integers(0, len(scan), max(0, count - len(scan)))]
    extra[:, :3] += rng.normal(0, JITTER_M, (len(extra), 3)).astype(np.float32)
    return np.ascontiguousarray(rng.permutation(np.concatenate([scan, extra]))[:count], np.float32)
