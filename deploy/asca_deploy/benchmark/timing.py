"""Statistics of the benchmarks: percentiles of frames, spreads of ratios, rounds with a progress bar."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asca_deploy.detector import Detector
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
        """Return the spread of unitless ratios (rounds,)."""
        return cls(*(float(np.percentile(ratios, q)) for q in (50, 25, 75)))


def run_frame(detector: Detector, scan: NDArray[Any]) -> FrameReport:
    """Run one scan (N, 4), LiDAR frame, and return its report."""
    return detector(scan).report


def pillars_of(frame: FrameReport) -> int:
    """Return a scan's pillars after the limits, the mean of its passes; 0 where the family has none."""
    return round(frame.counts.pillars / frame.passes) if isinstance(frame.counts, PillarCounts) else 0
