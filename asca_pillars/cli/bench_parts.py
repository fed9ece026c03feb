"""Parts of a benchmark, each measured and printed in turn."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from asca_deploy import Detector, find_bundle
from asca_deploy.benchmark import (
    BenchmarkReport,
    ColdStart,
    Comparison,
    Contestant,
    MatrixRow,
    Roofline,
    ScalingRow,
    Throughput,
    benchmark,
    cold_start,
    compare,
    measure_matrix,
    measure_roofline,
    measure_scaling,
    measure_throughput,
)
from asca_deploy.benchmark.speed_comparison import ON_THE_CPU, BoxDifference, box_difference
from asca_deploy.benchmark.timing import Spread
from asca_deploy.bundle import Bundle, PillarBundle
from asca_pillars.base.errors import ConfigError

_BOXES = "boxes: largest difference from the first row's (boxes without a partner)"


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
    lines = summary_lines(report)
    if not all(report.points_inside):
        lines.append("no roofline: the backbone has nothing to compute in a scan without points in the model's ranges")
    elif detector.view == "around" and detector.passes == 1:
        lines.append("no roofline: the bundle counts the backbone's operations in its own ranges, not all around")
    elif detector.provider in ON_THE_CPU:
        # The stage includes all passes of a scan, the backbone's operations are those of one pass.
        pass_ms = report.stages_ms["neck+head"].p50 / detector.passes
        roofline = measure_roofline(detector.bundle, pass_ms, detector.threads)
        result["roofline"] = asdict(roofline)
        lines.append(roofline_line(roofline, sparse=_has_sparse_backbone(detector.bundle)))
    console.print(stages_table(report))
    for line in (*lines, machine_line(report)):
        console.print(line, soft_wrap=True)
    if parts.stream:
        streamed = measure_throughput(detector, scans, rounds, bar)
        result["stream"] = asdict(streamed)
        console.print(stream_table(streamed))
    if parts.scaling:
        rows = measure_scaling(detector, scans[0], rounds=rounds, track=bar)
        result["scaling"] = [asdict(row) for row in rows]
        console.print(scaling_table(rows))
    if parts.compare:
        others = {name: _open_like(detector, folder) for name, folder in list(bundles.items())[1:]}
        compared = compare({next(iter(bundles)): detector} | others, scans, rounds, bar)
        detections, *other_detections = ([model(points) for points in scans] for model in (detector, *others.values()))
        boxes = {name: box_difference(detections, other) for name, other in zip(others, other_detections, strict=True)}
        result["compare"] = asdict(compared) | {
            "boxes": {name: asdict(difference) for name, difference in boxes.items()}
        }
        console.print(comparison_table(compared, boxes))
    if parts.matrix:
        ways = measure_matrix(bundles, scans, rounds, bar, mounting=detector.mounting, threads=detector.threads)
        result["matrix"] = [asdict(row) | {"way": row.way._asdict()} for row in ways]
        console.print(matrix_table(ways))
        for line in matrix_reasons(ways):
            console.print(line, soft_wrap=True)
    if parts.cold:
        cold = cold_start(detector, scans[0], track=bar)
        result["cold"] = asdict(cold)
        console.print(cold_line(cold), soft_wrap=True)
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


def stages_table(report: BenchmarkReport) -> Table:
    """Return a table with percentiles of every stage."""
    points = f"{min(report.points)}" if len(set(report.points)) == 1 else f"{min(report.points)}-{max(report.points)}"
    title = f"{report.bundle}: {report.frames} warm frames, {report.scans} scan(s) of {points} points"
    if report.passes > 1:
        title += f", {report.passes} passes each"
    table = _table(title, "stage", "p50 ms", "p95 ms", "p99 ms", "max ms", "min ms")
    for name, times in [*report.stages_ms.items(), ("total", report.total_ms)]:
        table.add_row(name, *(f"{value:.2f}" for value in (times.p50, times.p95, times.p99, times.max, times.min)))
    return table


def summary_lines(report: BenchmarkReport) -> list[str]:
    """Return late frames, FPS, the fraction of time outside the graphs, start and memory."""
    memory = "" if report.peak_memory_mib is None else f", peak memory {report.peak_memory_mib:.0f} MiB"
    late = []
    if report.deadline_ms is not None and report.late_share is not None:
        late = [f"later than {report.deadline_ms:g} ms: {report.late_share:.1%} of {report.frames} frames"]
    return [
        *late,
        f"{report.fps:.1f} FPS; loaded in {report.load_s:.2f} s, first scan {report.cold_ms:.0f} ms{memory}",
        f"outside the graphs: {report.outside_ms.p50:.1f} ms (p95 {report.outside_ms.p95:.1f}), "
        f"{report.outside_share:.0%}",
    ]


def machine_line(report: BenchmarkReport) -> str:
    """Return the machine, threads and versions of the measurements."""
    versions = ", ".join(f"{name} {version}" for name, version in report.versions.items())
    return f"{report.cpu}, {report.threads} threads, {report.runs_on}; {versions}"


def roofline_line(roofline: Roofline, *, sparse: bool) -> str:
    """Return achieved and possible rates; for a sparse neck both are means over the scans of its export."""
    rates = ", ".join(f"{kind} {rate:.0f}" for kind, rate in roofline.gemm_gmac_s.items())
    return (
        f"roofline: backbone {roofline.gmac:.1f} GMAC at {roofline.achieved_gmac_s:.0f} GMAC/s, {roofline.share:.0%} "
        f"of this machine's {roofline.type} matrix product (GMAC/s measured in onnxruntime, {roofline.threads} "
        f"threads: {rates})" + ("; GMAC of the mean scan of the export, these may have more or fewer" if sparse else "")
    )


def comparison_table(comparison: Comparison, boxes: Mapping[str, BoxDifference] | None = None) -> Table:
    """Return a table of bundles with their speed relative to the first and, if known, the difference of their boxes."""
    title = "; ".join([f"{comparison.rounds} rounds in turn", *([_BOXES] if boxes else [])])
    table = _table(title, "", "p50 ms", "p95 ms", "FPS", "times as fast", *(["boxes"] if boxes else []))
    for bundle in comparison.contestants:
        table.add_row(
            bundle.name,
            *_speed(bundle),
            *([_difference_text(boxes[bundle.name])] if boxes and bundle.name in boxes else []),
        )
    return table


def matrix_table(rows: Sequence[MatrixRow]) -> Table:
    """Return a table of all configurations that run; see `matrix_reasons` for the others."""
    title = f"Ways to run, in turn; {_BOXES}"
    columns = ("provider", "precision", "threads", "p50 ms", "FPS", "times as fast", "boxes")
    table = _table(title, "bundle", *columns, names=3)
    for row in rows:
        if row.speed is not None and row.boxes is not None:
            p50_ms, _, fps, speedup = _speed(row.speed)
            table.add_row(*row.way[:3], str(row.way.threads), p50_ms, fps, speedup, _difference_text(row.boxes))
    return table


def matrix_reasons(rows: Sequence[MatrixRow]) -> list[str]:
    """Return the reasons why configurations do not run, each once: they are the same for every bundle."""
    return list(
        dict.fromkeys(f"not {row.way.provider} {row.way.precision}: {row.reason}" for row in rows if row.reason)
    )


def scaling_table(rows: Sequence[ScalingRow]) -> Table:
    """Return a table of stages by number of points."""
    table = _table("p50 ms by number of points", "points", "pillars", *rows[0].stages_ms, "total", names=0)
    for row in rows:
        times = [f"{value:.2f}" for value in (*row.stages_ms.values(), row.total_ms)]
        table.add_row(f"{row.points:,}", f"{row.pillars:,}", *times)
    return table


def stream_table(throughput: Throughput) -> Table:
    """Return a table of single calls and streaming."""
    title = f"Stream: {_spread(throughput.gain)} times the scans per second, {throughput.rounds} rounds in turn"
    table = _table(title, "", "scans per second", "latency p50 ms", "p95 ms")
    for name, fps, latency in (
        ("one by one", throughput.single_fps, throughput.single_latency_ms),
        ("stream", throughput.stream_fps, throughput.stream_latency_ms),
    ):
        table.add_row(name, f"{fps:.1f}", f"{latency.p50:.1f}", f"{latency.p95:.1f}")
    return table


def cold_line(cold: ColdStart) -> str:
    """Return the times and the memory of a new process."""
    memory = cold.detect_peak_memory_mib
    return (
        f"new process: {cold.first_boxes_s:.2f} s to the first boxes (import {cold.import_s:.2f}, load "
        f"{cold.load_s:.2f}, first scan {cold.first_scan_s:.2f}; median of {cold.repeats})"
        + ("" if memory is None else f"; `asca detect` peaks at {memory:.0f} MiB")
    )


def _table(title: str, *columns: str, names: int = 1) -> Table:
    """Return a table whose first columns are text and the others numbers."""
    table = Table(title=title)
    for index, column in enumerate(columns):
        table.add_column(column, justify="left" if index < names else "right")
    return table


def _difference_text(boxes: BoxDifference) -> str:
    return f"{100 * boxes.center_size_m:.1f} cm ({boxes.lone})"


def _speed(bundle: Contestant) -> tuple[str, str, str, str]:
    return (
        f"{bundle.total_ms.p50:.1f}",
        f"{bundle.total_ms.p95:.1f}",
        f"{bundle.fps:.1f}",
        _spread(bundle.speedup),
    )


def _spread(ratio: Spread) -> str:
    return f"{ratio.median:.2f} ({ratio.low:.2f}-{ratio.high:.2f})"
