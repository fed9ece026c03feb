"""Cost of a new process: time to the first boxes, and the memory of `asca detect`."""

import json
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from time import time

import numpy as np
from numpy.typing import NDArray

from asca_deploy.benchmark.timing import Track, silently
from asca_deploy.detector import Detector
from asca_pillars.base.errors import AscaError
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
