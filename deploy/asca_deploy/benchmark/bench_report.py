"""Time per stage, memory and the hardware; warm frames apart from the cold first one.

`cold_start` measures a new process: time to the first boxes, and the memory of `asca detect`.
"""

import hashlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from time import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_deploy.benchmark.timing import Percentiles, Track, pillars_of, run_frame, silently
from asca_deploy.detector import Detector
from asca_pillars.base.errors import AscaError
from asca_pillars.base.system import cpu_model, package_versions
from asca_pillars.detection.detections import FrameReport
from asca_pillars.scans.mounting import Mounting

_FIRST_BOXES = """
import sys, time
from asca_deploy import Detector
imported = time.time()
import json, numpy
from asca_pillars.scans.mounting import Mounting
points, options, mounting = numpy.load(sys.argv[2]), json.loads(sys.argv[3]), json.loads(sys.argv[4])
start = time.time()
detector = Detector(sys.argv[1], mounting=Mounting(**mounting), **options)
loaded = time.time()
detector(points)
boxes = time.time()
print(json.dumps([imported, loaded - start, boxes - loaded, boxes]))
"""

_DETECT = """
import sys
from asca_deploy.benchmark.bench_report import peak_memory_mib
from asca_pillars.cli.main import app
app(["detect", sys.argv[2], "--bundle", sys.argv[1], "--out", sys.argv[3], *sys.argv[4:]], standalone_mode=False)
print(peak_memory_mib())
"""


@dataclass(frozen=True)
class ColdStart:
    """Medians over new processes; files are in the system's cache, compiled functions in theirs."""

    first_boxes_s: float
    """Time from the start of Python to the boxes of one scan."""
    import_s: float
    """Part of it: start of Python and imports."""
    load_s: float
    """Part of it: opening the bundle."""
    first_scan_s: float
    """Part of it: the first scan."""
    detect_peak_memory_mib: float | None
    """Largest resident memory of `asca detect` on that scan, with pictures; None if the system does not report it."""
    repeats: int


def cold_start(
    detector: Detector,
    scan: NDArray[np.float32],
    repeats: int = 5,
    track: Track = silently,
) -> ColdStart:
    """Start new processes that do with `scan` (N, 4), LiDAR frame, what `detector` would.

    Raises:
        AscaError: a process failed; the message says how.
    """
    bundle = detector.folder
    options = {"provider": detector.provider, "precision": detector.precision, "threads": detector.threads}
    arguments = [text for name, value in options.items() for text in (f"--{name}", str(value))]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scan.npy"
        np.save(path, scan)
        arguments += ["--reflectance-scale", "1", *_mounting_options(detector.mounting, Path(folder))]
        memory = _run(_DETECT, bundle, path, Path(folder) / "out", *arguments).splitlines()[-1]
        given = json.dumps(options), json.dumps(asdict(detector.mounting), default=float)
        times = np.array([_first_boxes(bundle, path, *given) for _ in track(repeats, "new processes")])
    first_boxes_s, import_s, load_s, first_scan_s = (float(value) for value in np.median(times, axis=0))
    peak_mib = None if memory == "None" else float(memory)
    return ColdStart(first_boxes_s, import_s, load_s, first_scan_s, peak_mib, repeats)


def _mounting_options(mounting: Mounting, folder: Path) -> list[str]:
    """Return the mounting as options of `asca detect`, which reads a pose from a file: one in `folder`."""
    options = [] if mounting.sensor_height_m is None else ["--sensor-height", str(mounting.sensor_height_m)]
    if mounting.pose is None:
        return [*options, "--axes", mounting.axes]
    np.savetxt(folder / "pose.txt", mounting.pose)
    return [*options, "--pose", str(folder / "pose.txt")]


def _first_boxes(bundle: Path, scan: Path, options: str, mounting: str) -> tuple[float, float, float, float]:
    start = time()
    imported, load_s, first_scan_s, boxes = json.loads(_run(_FIRST_BOXES, bundle, scan, options, mounting))
    return boxes - start, imported - start, load_s, first_scan_s


def _run(code: str, *arguments: object) -> str:
    command = [sys.executable, "-c", code, *map(str, arguments)]
    result = subprocess.run(command, capture_output=True, text=True)
    if result.returncode:
        last = (result.stderr.strip().splitlines() or ["it said nothing"])[-1]
        raise AscaError(f"a new process could not detect anything: {last}; try `asca detect` by hand")
    return result.stdout


STATUS = Path("/proc/self/status")


@dataclass(frozen=True)
class BenchmarkReport:
    """Result of `benchmark`."""

    fps: float
    """1 / p50 of the whole chain, points in, detections out; files are not read and pictures not drawn."""
    total_ms: Percentiles
    stages_ms: dict[str, Percentiles]
    outside_ms: Percentiles
    """Time outside the graphs: input check, pillars, scatter, decoding and suppression."""
    outside_share: float
    """Median over frames of outside / total."""
    cold_ms: float
    """The first scan, a fresh detector's very first one."""
    load_s: float
    """Time to open the bundle: checksums, sessions, canvas."""
    frames: int
    """Measured warm frames."""
    passes: int
    """Passes of the network for each frame."""
    scans: int
    points: tuple[int, ...]
    """Points of each scan."""
    points_inside: tuple[int, ...]
    """Points of each scan within the model's ranges, summed over the passes."""
    pillars: tuple[int, ...]
    """Pillars of each scan after the limits, the mean of the passes."""
    detections: tuple[int, ...]
    provider: str
    precision: str
    """float32 or reduced, see `asca_deploy.providers`."""
    runs_on: str
    """Provider and arithmetic in words, `Detector.runs_on`."""
    threads: int
    cpu: str
    peak_memory_mib: float | None
    """Largest resident memory of the process so far; None if the system does not report it."""
    versions: dict[str, str]
    bundle: str
    graphs_sha256: dict[str, str]
    input_sha256: str
    made_by: dict[str, str]
    """The model, its weights' digest and the version, `Detector.made_by`."""
    deadline_ms: float | None = None
    late_share: float | None = None
    """Share of the measured frames that took longer than the deadline."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self)


def benchmark(
    detector: Detector,
    scans: Sequence[NDArray[np.float32]],
    rounds: int = 30,
    warmup: int = 3,
    track: Track = silently,
    *,
    deadline_ms: float | None = None,
) -> BenchmarkReport:
    """Time `rounds` passes over `scans` after `warmup` passes that are not counted.

    Args:
        detector: a fresh one, so that its first scan shows the cold start.
        scans: (N, 4) each, LiDAR frame, as for the detector.
        deadline_ms: count the frames that take longer.

    Raises:
        ValueError: there is no scan or no round.
    """
    if not scans or rounds < 1:
        raise ValueError(f"{len(scans)} scans, {rounds} rounds: at least one of each is needed")
    cold_ms = run_frame(detector, scans[0]).total_ms
    for _ in track(warmup, "warm-up"):
        for scan in scans:
            detector(scan)
    passes = [[run_frame(detector, scan) for scan in scans] for _ in track(rounds, "stages")]
    frames = [frame for one_pass in passes for frame in one_pass]
    total_ms = Percentiles.of([frame.total_ms for frame in frames])
    outside_ms = [_outside_ms(frame, detector.pipeline.network_stages) for frame in frames]
    return BenchmarkReport(
        fps=1e3 / total_ms.p50,
        total_ms=total_ms,
        stages_ms={s: Percentiles.of([f.times_ms[s] for f in frames]) for s in frames[0].times_ms},
        outside_ms=Percentiles.of(outside_ms),
        outside_share=float(np.median([o / f.total_ms for o, f in zip(outside_ms, frames, strict=True)])),
        cold_ms=cold_ms,
        load_s=detector.load_s,
        frames=len(frames),
        passes=detector.passes,
        scans=len(scans),
        points=tuple(len(scan) for scan in scans),
        points_inside=tuple(frame.counts.points - frame.counts.points_outside for frame in passes[0]),
        pillars=tuple(pillars_of(frame) for frame in passes[0]),
        detections=tuple(len(detector(scan)) for scan in scans),
        provider=detector.provider,
        precision=detector.precision,
        runs_on=detector.runs_on,
        threads=detector.threads,
        cpu=cpu_model(),
        peak_memory_mib=peak_memory_mib(),
        versions=package_versions(),
        bundle=detector.bundle.name,
        graphs_sha256={name: graph.sha256 for name, graph in detector.bundle.graphs.items()},
        input_sha256=_sha256(scans),
        made_by=detector.made_by,
        deadline_ms=deadline_ms,
        late_share=None if deadline_ms is None else float(np.mean([f.total_ms > deadline_ms for f in frames])),
    )


def _outside_ms(frame: FrameReport, network_stages: Sequence[str]) -> float:
    return frame.total_ms - sum(frame.times_ms[stage] for stage in network_stages)


def _sha256(scans: Sequence[NDArray[np.float32]]) -> str:
    digest = hashlib.sha256()
    for scan in scans:
        digest.update(np.ascontiguousarray(scan, "<f4").tobytes())
    return digest.hexdigest()


def peak_memory_mib() -> float | None:
    """Return the largest resident memory of the process so far; None if the system does not report it.

    Linux keeps the figure of getrusage across exec, which is too large for a small program started by a large one;
    /proc is correct.
    """
    if (peak := _status_mib("VmHWM")) is not None:
        return peak
    if sys.platform == "win32":
        return None
    import resource  # does not exist on Windows

    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(largest / 2**20 if sys.platform == "darwin" else largest / 2**10)  # bytes there, KiB elsewhere


def resident_mib() -> float | None:
    """Return the resident memory of the process now; None if the system does not report it."""
    return _status_mib("VmRSS")


def _status_mib(key: str) -> float | None:
    try:
        lines = STATUS.read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) / 2**10 for line in lines if line.startswith(f"{key}:")), None)
