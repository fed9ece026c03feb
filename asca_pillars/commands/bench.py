"""`asca bench`: where the milliseconds go, and on what machine."""

import json
import logging
import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from asca_deploy import Detector, find_bundle, load_bundle, sample_scan_path
from asca_deploy.benchmark import (
    benchmark,
    cold_start,
    compare,
    measure_matrix,
    measure_roofline,
    measure_scaling,
    measure_throughput,
)
from asca_deploy.benchmark.matrix import ON_THE_CPU
from asca_deploy.providers import Precision, Provider
from asca_pillars.commands import bench_tables as show
from asca_pillars.data.scans.scan_reader import find_scans, read_scan
from asca_pillars.errors import ConfigError, ScanError
from asca_pillars.files import atomic_path


@dataclass(frozen=True)
class Parts:
    """What to measure besides the stages."""

    compare: Sequence[Path] = ()
    """Other bundles."""
    matrix: bool = False
    scaling: bool = False
    stream: bool = False
    cold: bool = False


def run(
    scans: Path | None,
    bundle: Path | None,
    provider: str,
    precision: str | None,
    threads: int | None,
    rounds: int,
    parts: Parts,
    report_path: Path | None,
) -> None:
    """See `asca bench --help`."""
    # A pipe has no width, and the tables are wider than the 80 columns that rich takes then.
    piped = not sys.stdout.isatty() and "COLUMNS" not in os.environ
    console = Console(markup=False, highlight=False, width=120 if piped else None)
    logging.getLogger("asca_deploy").setLevel(logging.ERROR)  # `asca detect` warns of odd scans; here they are timed
    points = [read_scan(path).points for path in find_scans(sample_scan_path() if scans is None else scans)]
    if parts.scaling and not len(points[0]):
        raise ScanError("the first scan has no points to take fewer or more of; give another for --scaling")
    bundles = _named([bundle, *parts.compare])
    for folder in bundles.values():
        load_bundle(folder)  # a damaged one is said now and not after minutes
    detector = Detector(
        bundle,
        provider=cast("Provider", provider),  # checked by Detector, as the precision is
        precision=cast("Precision | None", precision),
        threads=threads,
    )
    result = _measure(detector, points, rounds, parts, bundles, console)
    if report_path is not None:
        with atomic_path(report_path) as temporary:
            temporary.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def _measure(
    detector: Detector,
    scans: list[NDArray[np.float32]],
    rounds: int,
    parts: Parts,
    bundles: dict[str, Path],
    console: Console,
) -> dict[str, Any]:
    """Measure part after part, print each when it is there, and return everything as plain values."""

    def bar(count: int, what: str) -> Iterable[int]:
        return track(range(count), what, console=console, transient=True)

    report = benchmark(detector, scans, rounds, track=bar)
    result = report.to_dict()
    lines = show.summary_lines(report)
    if detector.provider in ON_THE_CPU:
        found = measure_roofline(detector.bundle, report.stages_ms["neck+head"].p50, detector.threads)
        result["roofline"] = asdict(found)
        lines.append(show.roofline_line(found))
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
        others = {name: _like(detector, folder) for name, folder in list(bundles.items())[1:]}
        compared = compare({next(iter(bundles)): detector} | others, scans, rounds, bar)
        result["compare"] = asdict(compared)
        console.print(show.comparison_table(compared))
    if parts.matrix:
        ways = measure_matrix(bundles, scans, rounds, bar)
        result["matrix"] = [asdict(row) | {"way": row.way._asdict()} for row in ways]
        console.print(show.matrix_table(ways))
        for line in show.matrix_reasons(ways):
            console.print(line, soft_wrap=True)
    if parts.cold:
        cold = cold_start(detector, scans[0], track=bar)
        result["cold"] = asdict(cold)
        console.print(show.cold_line(cold), soft_wrap=True)
    return result


def _like(detector: Detector, folder: Path) -> Detector:
    """Another bundle, run the same way."""
    return Detector(folder, provider=detector.provider, precision=detector.precision, threads=detector.threads)


def _named(bundles: Sequence[Path | None]) -> dict[str, Path]:
    """Folders by the names that tables show them by."""
    folders = [find_bundle(bundle) for bundle in bundles]
    named = {folder.name: folder for folder in folders}
    if len(named) < len(folders):  # two folders of one name are told apart by their whole path
        named = {str(folder): folder for folder in folders}
    if len(named) < len(folders):
        raise ConfigError(f"--compare {bundles[-1]}: a bundle is compared with itself or given twice; name another one")
    return named
