"""Statistics of the benchmarks: percentiles of frames, spreads of ratios, rounds with a progress bar.

`throughput` counts scans per second of `Detector.stream`, and `scaling` times stages over the number of points.

The roofline is the backbone's share of the arithmetic throughput of the machine. Its ceiling is measured, not looked
up: a product of two large matrices by onnxruntime's CPU provider with the same number of threads, one of them constant
as a network's weights are. gemm_*.onnx come from benchmarks/gemm_graphs.py.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from itertools import cycle, islice
from time import perf_counter
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asca_deploy.bundle import Bundle
from asca_deploy.detector import Detector
from asca_deploy.onnx_runtime import onnxruntime
from asca_pillars.detection.detections import FrameReport
from asca_pillars.ops.pillar.prepare import PillarCounts

Track: TypeAlias = Callable[[int, str], Iterable[int]]
"""Yields 0..count-1 for a named task; a command line shows a progress bar for it."""


def silently(count: int, what: str) -> Iterable[int]:
    """Track without showing progress."""
    return range(count)


@dataclass(frozen=True)
class Percentiles:
    """Wall time over the measured frames, milliseconds."""

    p50: float
    p95: float
    p99: float
    max: float
    min: float

    @classmethod
    def of(cls, times_ms: list[float] | NDArray[np.float64]) -> "Percentiles":
        """Return the percentiles of times (F,), or (R, F) of R rounds, in ms, over all of them."""
        return cls(*(float(np.percentile(times_ms, q)) for q in (50, 95, 99, 100, 0)))


@dataclass(frozen=True)
class Spread:
    """A ratio that was measured once per round: its median and its quartiles over the rounds."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, ratios: list[float] | NDArray[np.float64]) -> "Spread":
        """Return the spread of ratios (rounds,)."""
        return cls(*(float(np.percentile(ratios, q)) for q in (50, 25, 75)))


def run_frame(detector: Detector, scan: NDArray[Any]) -> FrameReport:
    """Run one scan (N, 4), LiDAR frame, and return its report."""
    return detector(scan).report


def pillars_of(frame: FrameReport) -> int:
    """Return a scan's pillars after the limits, the mean of its passes; 0 where the family has none."""
    return round(frame.counts.pillars / frame.passes) if isinstance(frame.counts, PillarCounts) else 0


SIZE = 2048
"""Rows and columns of the constant matrix in both graphs."""
RUNS, BUDGET_S = 7, 0.6  # per type: the median of so many, or of as many as the time allows on a slow machine


@dataclass(frozen=True)
class Roofline:
    """Rate of the backbone against the machine's rate of multiplying matrices."""

    gmac: float
    """Multiply-accumulates of the backbone, 1e9."""
    achieved_gmac_s: float
    """Rate of neck and head at their p50, for one pass."""
    gemm_gmac_s: dict[str, float]
    """Measured rate by type, float32 and int8."""
    type: str
    """Type in which the bundle's backbone multiplies."""
    share: float
    """achieved / measured rate of that type. A provider that computes in less precision can exceed 1."""
    threads: int


def measure_roofline(bundle: Bundle, backbone_ms: float, threads: int) -> Roofline:
    """Measure the machine and relate `backbone_ms` to it, the p50 of neck and head in one pass; up to two seconds.

    Args:
        threads: as the detector has.
    """
    rates = {kind: gemm_rate(kind, threads) for kind in ("float32", "int8")}
    achieved = bundle.backbone_gmac / backbone_ms * 1e3
    share = achieved / rates[bundle.precision]
    return Roofline(bundle.backbone_gmac, achieved, rates, bundle.precision, share, threads)


def gemm_rate(kind: str, threads: int, rows: int = SIZE) -> float:
    """Measure multiply-accumulates per second, 1e9, of (rows, SIZE) @ (SIZE, SIZE) in onnxruntime: a median.

    Args:
        kind: "float32", or "int8" for uint8 x int8 -> int32.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    graph = resources.files("asca_deploy.benchmark").joinpath(f"gemm_{kind}.onnx").read_bytes()
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    feed = {"a": _matrix(kind, rows)}
    session.run(None, feed)
    seconds: list[float] = []
    while len(seconds) < RUNS and sum(seconds) < BUDGET_S:
        start = perf_counter()
        session.run(None, feed)
        seconds.append(perf_counter() - start)
    return rows * SIZE**2 / float(np.median(seconds)) / 1e9


def _matrix(kind: str, rows: int) -> NDArray[np.generic]:
    rng = np.random.default_rng(0)
    if kind == "int8":
        return rng.integers(0, 256, (rows, SIZE), np.uint8)
    return rng.standard_normal((rows, SIZE), np.float32)


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
