"""Comparison of detectors: speed in alternation, so that a busy machine slows all alike, and differences of boxes.

The matrix compares providers, precisions and threads for a bundle on this machine.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asca_deploy.benchmark.timing import Percentiles, Spread, Track, silently
from asca_deploy.detector import Detector
from asca_deploy.providers import PRECISIONS, PROVIDERS, Precision, Provider
from asca_pillars.base.errors import AscaError
from asca_pillars.base.system import default_threads
from asca_pillars.detection.detections import Detections
from asca_pillars.scans.mounting import Mounting

Run: TypeAlias = Callable[[NDArray[np.float32]], object]

FRAMES_PER_TURN = 3  # at least so many are timed, after one that is not: it finds the caches full of another's weights


@dataclass(frozen=True)
class Contestant:
    """One of those compared."""

    name: str
    total_ms: Percentiles
    """Over all frames of all rounds."""
    fps: float
    """1 / p50."""
    speedup: Spread
    """Speed relative to the first one: ratio of the two medians of a round, over the rounds."""


@dataclass(frozen=True)
class Comparison:
    """Result of `compare`."""

    rounds: int
    contestants: tuple[Contestant, ...]
    """Contestants as they were given; the first one is the reference."""


def compare(
    runs: Mapping[str, Run], scans: Sequence[NDArray[np.float32]], rounds: int = 10, track: Track = silently
) -> Comparison:
    """Time several detectors in alternation on scans (N, 4), LiDAR frame; see `alternate`."""
    times_ms = alternate(runs, scans, rounds, track)
    medians = {name: np.median(times, axis=1) for name, times in times_ms.items()}
    first = next(iter(medians.values()))
    return Comparison(
        rounds,
        tuple(
            Contestant(
                name,
                total_ms=Percentiles.of(times),
                fps=1e3 / float(np.median(times)),
                speedup=Spread.of(first / medians[name]),
            )
            for name, times in times_ms.items()
        ),
    )


def alternate(
    runs: Mapping[str, Run], scans: Sequence[NDArray[np.float32]], rounds: int, track: Track = silently
) -> dict[str, NDArray[np.float64]]:
    """Return the wall times of several detectors that take turns, never two at a time.

    Args:
        runs: by name; called with a scan.
        scans: (N, 4) each; in every round each detector gets all of them, and again until there are enough for a
            median. Every other round goes through the detectors backwards.

    Returns:
        By name (rounds, frames), in ms; divide medians over the frames of the same round for ratios that a
        busy machine does not spoil.

    Raises:
        ValueError: there is no scan, no round or no detector.
    """
    if not scans or not runs or rounds < 1:
        raise ValueError(f"{len(runs)} detectors, {len(scans)} scans, {rounds} rounds: at least one of each is needed")
    frames = [*scans] * -(-FRAMES_PER_TURN // len(scans))
    times_ms = {name: np.empty((rounds, len(frames))) for name in runs}
    for number in track(rounds, f"{len(runs)} in turn"):
        for name in list(runs)[:: 1 if number % 2 == 0 else -1]:
            runs[name](frames[0])
            times_ms[name][number] = [_time_ms(runs[name], scan) for scan in frames]
    return times_ms


def _time_ms(run: Run, scan: NDArray[np.float32]) -> float:
    start = perf_counter()
    run(scan)
    return (perf_counter() - start) * 1e3


SAME_OBJECT_M = 0.5  # boxes of a class whose centers are farther apart than this are of different objects


@dataclass(frozen=True)
class BoxDifference:
    """Largest differences between boxes of the same objects, and how many boxes have no partner."""

    pairs: int
    lone: int
    """Boxes of either side without one of the other within SAME_OBJECT_M."""
    center_size_m: float
    """Largest difference of a center coordinate, length, width or height."""
    score: float


def box_difference(expected: Sequence[Detections], others: Sequence[Detections]) -> BoxDifference:
    """Pair the boxes of the same scans, each with the nearest one of its class that is still free, best first."""
    pairs = lone = 0
    largest_m = largest_score = 0.0
    for reference, compared in zip(expected, others, strict=True):
        free, names = np.ones(len(compared), bool), np.array(compared.names, dtype=str)
        for box, score, name in zip(reference.boxes, reference.scores, reference.names, strict=True):
            distances = np.linalg.norm(compared.boxes[:, :3] - box[:3], axis=1)
            distances[~free | (names != name)] = np.inf
            if distances.min(initial=np.inf) > SAME_OBJECT_M:
                lone += 1
                continue
            nearest = int(distances.argmin())
            free[nearest] = False
            pairs += 1
            largest_m = max(largest_m, float(np.abs(compared.boxes[nearest, :6] - box[:6]).max()))
            largest_score = max(largest_score, float(abs(compared.scores[nearest] - score)))
        lone += int(free.sum())
    return BoxDifference(pairs, lone, largest_m, largest_score)


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
