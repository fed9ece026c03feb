"""Time of each stage as a function of the number of points."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asca_deploy.benchmark.timing import Track, pillars_of, run_frame, silently
from asca_deploy.detector import Detector

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
