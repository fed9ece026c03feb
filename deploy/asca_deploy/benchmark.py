"""How fast the detector is, stage by stage, and on what; warm frames apart from the cold first one."""

import hashlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_deploy.detector import Detector
from asca_deploy.frame import FrameReport
from asca_pillars.environment import package_versions
from asca_pillars.machine import cpu_model


@dataclass(frozen=True)
class Percentiles:
    """Wall time over the measured frames, milliseconds."""

    p50: float
    p95: float
    min: float


@dataclass(frozen=True)
class BenchmarkReport:
    """Result of `benchmark`."""

    fps: float
    """1 / p50 of the whole chain, points in, detections out; files are not read and pictures not drawn."""
    total_ms: Percentiles
    stages_ms: dict[str, Percentiles]
    cold_ms: float | None
    """The detector's very first scan; None if it had run before."""
    load_s: float
    """Opening the bundle: checksums, sessions, canvas."""
    frames: int
    """Measured warm frames."""
    scans: int
    points: tuple[int, ...]
    """Points of each scan."""
    pillars: tuple[int, ...]
    """Pillars of each scan after the limits."""
    detections: tuple[int, ...]
    provider: str
    threads: int
    cpu: str
    peak_memory_mib: float | None
    """Largest resident memory of the process so far; None where the system does not say."""
    versions: dict[str, str]
    bundle: str
    graphs_sha256: dict[str, str]
    input_sha256: str

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)


def benchmark(
    detector: Detector, scans: Sequence[NDArray[np.float32]], rounds: int = 30, warmup: int = 3
) -> BenchmarkReport:
    """Time `rounds` passes over `scans` after `warmup` passes that are not counted.

    Args:
        detector: a fresh one, so that its first scan shows the cold start.
        scans: (N, 4) each, as for the detector.

    Raises:
        ValueError: there is no scan or no round.
    """
    if not scans or rounds < 1:
        raise ValueError(f"{len(scans)} scans, {rounds} rounds: at least one of each is needed")
    cold_ms = _frame(detector, scans[0]).total_ms if detector.last_frame is None else None
    for _ in range(warmup):
        for scan in scans:
            detector(scan)
    passes = [[_frame(detector, scan) for scan in scans] for _ in range(rounds)]
    frames = [frame for one_pass in passes for frame in one_pass]
    total_ms = _percentiles([frame.total_ms for frame in frames])
    graphs = detector.bundle.graphs
    return BenchmarkReport(
        fps=1e3 / total_ms.p50,
        total_ms=total_ms,
        stages_ms={s: _percentiles([f.times_ms[s] for f in frames]) for s in frames[0].times_ms},
        cold_ms=cold_ms,
        load_s=detector.load_s,
        frames=len(frames),
        scans=len(scans),
        points=tuple(len(scan) for scan in scans),
        pillars=tuple(frame.counts.pillars for frame in passes[0]),
        detections=tuple(len(detector(scan)) for scan in scans),
        provider=detector.provider,
        threads=detector.threads,
        cpu=cpu_model(),
        peak_memory_mib=_peak_memory_mib(),
        versions=package_versions(),
        bundle=detector.bundle.name,
        graphs_sha256={"encoder": graphs.encoder.sha256, "backbone": graphs.backbone.sha256},
        input_sha256=_sha256(scans),
    )


def compare(
    detectors: Mapping[str, Detector], scans: Sequence[NDArray[np.float32]], rounds: int = 10
) -> dict[str, NDArray[np.float64]]:
    """Time several detectors in alternation, so that whatever else the machine does meets all of them alike.

    Args:
        detectors: by name.
        scans: (N, 4) each; every round passes all of them through every detector.

    Returns:
        By name (rounds,) the median time of one scan in each round, milliseconds; divide two of them element by element
        for ratios that a busy machine does not spoil.
    """
    for detector in detectors.values():
        detector(scans[0])
    times = {name: np.empty(rounds) for name in detectors}
    for number in range(rounds):
        for name, detector in detectors.items():
            times[name][number] = np.median([_frame(detector, scan).total_ms for scan in scans])
    return times


def _frame(detector: Detector, scan: NDArray[np.float32]) -> FrameReport:
    detector(scan)
    assert detector.last_frame is not None
    return detector.last_frame


def _percentiles(times_ms: list[float]) -> Percentiles:
    return Percentiles(*(float(np.percentile(times_ms, q)) for q in (50, 95, 0)))


def _peak_memory_mib() -> float | None:
    if sys.platform == "win32":
        return None
    import resource  # does not exist on Windows

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(peak / 2**20 if sys.platform == "darwin" else peak / 2**10)  # bytes there, KiB elsewhere


def _sha256(scans: Sequence[NDArray[np.float32]]) -> str:
    digest = hashlib.sha256()
    for scan in scans:
        digest.update(np.ascontiguousarray(scan, "<f4").tobytes())
    return digest.hexdigest()
