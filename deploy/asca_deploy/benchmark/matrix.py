"""Comparison of providers, precisions and threads for a bundle on this machine."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_deploy.benchmark.speed_comparison import BoxDifference, Contestant, box_difference, compare
from asca_deploy.benchmark.timing import Track, silently
from asca_deploy.detector import Detector
from asca_deploy.providers import PRECISIONS, PROVIDERS, Precision, Provider
from asca_pillars.base.errors import AscaError
from asca_pillars.base.system import default_threads
from asca_pillars.scans.mounting import Mounting

ON_THE_CPU = ("cpu", "openvino")  # the number of threads matters to these


class RunConfiguration(NamedTuple):
    """One way of running a bundle."""

    bundle: str
    provider: Provider
    precision: Precision
    threads: int


@dataclass(frozen=True)
class MatrixRow:
    """One way of running a bundle, how fast it is and how much its boxes differ from the reference's; or why not."""

    way: RunConfiguration
    speed: Contestant | None
    """`speedup` is over the reference: the first bundle on stock onnxruntime's CPU provider, default threads."""
    boxes: BoxDifference | None
    """Against the reference's boxes, over all scans."""
    reason: str | None
    """Reason why it cannot run here; None if it can."""


def measure_matrix(
    bundles: Mapping[str, Path],
    scans: Sequence[NDArray[np.float32]],
    rounds: int = 10,
    track: Track = silently,
    mounting: Mounting | None = None,
    threads: int | None = None,
) -> tuple[MatrixRow, ...]:
    """Open every way that there is and time those that run in alternation.

    Args:
        bundles: folders by name. The first one's default on the CPU is the reference and the first row.
        scans: (N, 4) each, LiDAR frame.
        mounting: of their sensor.
        threads: compared with a single one; None for the physical cores granted to the process.
    """
    opened: dict[RunConfiguration, Detector | str] = {}
    configurations = [
        way
        for bundle in bundles
        for way in _run_configurations(bundle, default_threads() if threads is None else threads)
    ]
    for number in track(len(configurations), "opening"):
        way = configurations[number]
        # A way that fails with these threads fails with others too, and gets one row.
        if not any(isinstance(result, str) and _same_but_threads(way, other) for other, result in opened.items()):
            opened[way] = _open(bundles[way.bundle], way, scans[0], mounting)
    detectors = {str(way): detector for way, detector in opened.items() if isinstance(detector, Detector)}
    speeds = {speed.name: speed for speed in compare(detectors, scans, rounds, track).contestants}
    boxes = {name: [detector(scan) for scan in scans] for name, detector in detectors.items()}
    reference = next(iter(boxes.values()))
    return tuple(
        MatrixRow(way, None, None, result)
        if isinstance(result, str)
        else MatrixRow(way, speeds[str(way)], box_difference(reference, boxes[str(way)]), None)
        for way, result in opened.items()
    )


def _run_configurations(bundle: str, most: int) -> list[RunConfiguration]:
    return [
        RunConfiguration(bundle, provider, precision, threads)
        for provider in sorted(PROVIDERS, key=lambda name: name != "cpu")
        for precision in PRECISIONS
        for threads in sorted({most, 1} if provider in ON_THE_CPU else {most}, reverse=True)
    ]


def _same_but_threads(way: RunConfiguration, failed: RunConfiguration) -> bool:
    """Return whether `way` would fail for the same reason; another precision might not."""
    return way[:3] == failed[:3]


def _open(folder: Path, way: RunConfiguration, scan: NDArray[np.float32], mounting: Mounting | None) -> Detector | str:
    """Return the detector after its first scan, or why it cannot be opened."""
    try:
        detector = Detector(
            folder, provider=way.provider, precision=way.precision, threads=way.threads, mounting=mounting
        )
        detector(scan)
    except AscaError as error:
        return str(error)
    return detector
