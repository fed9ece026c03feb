"""Parts of a benchmark, each measured and printed in turn."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from asca_deploy import Detector, find_bundle
from asca_deploy.benchmark import (
    benchmark,
    cold_start,
    compare,
    measure_matrix,
    measure_roofline,
    measure_scaling,
    measure_throughput,
)
from asca_deploy.benchmark.box_differences import box_difference
from asca_deploy.benchmark.matrix import ON_THE_CPU
from asca_deploy.bundle import Bundle, PillarBundle
from asca_pillars.base.errors import ConfigError
from asca_pillars.cli import bench_tables as show


@dataclass(frozen=True)
class Parts:
    """Parts to measure in addition to the stages."""

    compare: bool = False
    matrix: bool = False
    scaling: bool = False
    stream: bool = False
    cold: bool = False
    deadline_ms: float | None = None


def measure_parts(
    detector: Detector,
    scans: list[NDArray[np.float32]],
    rounds: int,
    parts: Parts,
    bundles: dict[str, Path],
    console: Console,
) -> dict[str, Any]:
    """Measure part after part, print each when it is there, and return everything as plain values.

    Scans are (N, 4): x, y, z in metres, LiDAR frame, and reflectance.
    """

    def bar(count: int, what: str) -> Iterable[int]:
        return track(range(count), what, console=console, transient=True)

    report = benchmark(detector, scans, rounds, track=bar, deadline_ms=parts.deadline_ms)
    result = report.to_dict()
    lines = show.summary_lines(report)
    if not all(report.points_inside):
        lines.append("no roofline: the backbone has nothing to compute in a scan without points in the model's ranges")
    elif detector.provider in ON_THE_CPU:
        # The stage includes all passes of a scan, the backbone's operations are those of one pass.
        pass_ms = report.stages_ms["neck+head"].p50 / detector.passes
        roofline = measure_roofline(detector.bundle, pass_ms, detector.threads)
        result["roofline"] = asdict(roofline)
        lines.append(show.roofline_line(roofline, sparse=_has_sparse_backbone(detector.bundle)))
    console.print(show.stages_table(report))
    for line in (*lines, show.machine_line(report)):
        console.print(line, soft_wrap=True)
    if parts.stream:
        streamed = measure_throughput(detector, scans, rounds, bar)
        result["stream"] = asdict(streamed)
        console.print(show.stream_table(streamed))
    if parts.scaling:
        rows = measure_scaling(detector, scans[0], rounds=rounds, track=bar)
        result["scaling"] = [asdict(row) for row in rows]
        console.print(show.scaling_table(rows))
    if parts.compare:
        others = {name: _open_like(detector, folder) for name, folder in list(bundles.items())[1:]}
        compared = compare({next(iter(bundles)): detector} | others, scans, rounds, bar)
        found, *theirs = ([one(points) for points in scans] for one in (detector, *others.values()))
        boxes = {name: box_difference(found, other) for name, other in zip(others, theirs, strict=True)}
        result["compare"] = asdict(compared) | {"boxes": {name: asdict(one) for name, one in boxes.items()}}
        console.print(show.comparison_table(compared, boxes))
    if parts.matrix:
        ways = measure_matrix(bundles, scans, rounds, bar, mounting=detector.mounting, threads=detector.threads)
        result["matrix"] = [asdict(row) | {"way": row.way._asdict()} for row in ways]
        console.print(show.matrix_table(ways))
        for line in show.matrix_reasons(ways):
            console.print(line, soft_wrap=True)
    if parts.cold:
        cold = cold_start(detector, scans[0], track=bar)
        result["cold"] = asdict(cold)
        console.print(show.cold_line(cold), soft_wrap=True)
    return result


def _has_sparse_backbone(bundle: Bundle) -> bool:
    """Return whether the backbone's operations differ between scans."""
    return not isinstance(bundle, PillarBundle) or bundle.pillar.neck == "sparse"


def _open_like(detector: Detector, folder: Path) -> Detector:
    """Open another bundle with the same settings."""
    return Detector(
        folder,
        provider=detector.provider,
        precision=detector.precision,
        threads=detector.threads,
        mounting=detector.mounting,
        view=detector.view,
    )


def named_bundles(bundles: Sequence[Path | None]) -> dict[str, Path]:
    """Return folders by their names in tables."""
    folders: list[Path] = []
    for bundle in bundles:
        folder = find_bundle(bundle)
        if folder.resolve() in (other.resolve() for other in folders):
            raise ConfigError(f"--compare {bundle}: a bundle is compared with itself or given twice; name another one")
        folders.append(folder)
    named = {folder.name: folder for folder in folders}
    if len(named) < len(folders):  # folders of equal names are named by their whole paths
        named = {str(folder): folder for folder in folders}
    return named
