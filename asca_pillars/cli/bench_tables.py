"""Output of `asca bench`: a table or a line for each part of a benchmark."""

from collections.abc import Mapping, Sequence

from rich.table import Table

from asca_deploy.benchmark import (
    BenchmarkReport,
    ColdStart,
    Comparison,
    Contestant,
    MatrixRow,
    Roofline,
    ScalingRow,
    Throughput,
)
from asca_deploy.benchmark.box_differences import BoxDifference
from asca_deploy.benchmark.timing import Spread

_BOXES = "boxes: largest difference from the first row's (boxes without a partner)"


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


def roofline_line(found: Roofline, *, sparse: bool) -> str:
    """Return achieved and possible rates; for a sparse neck both are means over the scans of its export."""
    rates = ", ".join(f"{kind} {rate:.0f}" for kind, rate in found.gemm_gmac_s.items())
    return (
        f"roofline: backbone {found.gmac:.1f} GMAC at {found.achieved_gmac_s:.0f} GMAC/s, {found.share:.0%} of this "
        f"machine's {found.type} matrix product (GMAC/s measured in onnxruntime, {found.threads} threads: {rates})"
        + ("; GMAC of the mean scan of the export, these may have more or fewer" if sparse else "")
    )


def comparison_table(found: Comparison, boxes: Mapping[str, BoxDifference] | None = None) -> Table:
    """Return a table of bundles with their speed relative to the first and, if known, the difference of their boxes."""
    title = "; ".join([f"{found.rounds} rounds in turn", *([_BOXES] if boxes else [])])
    table = _table(title, "", "p50 ms", "p95 ms", "FPS", "times as fast", *(["boxes"] if boxes else []))
    for one in found.contestants:
        table.add_row(
            one.name, *_speed(one), *([_difference_text(boxes[one.name])] if boxes and one.name in boxes else [])
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


def stream_table(found: Throughput) -> Table:
    """Return a table of single calls and streaming."""
    title = f"Stream: {_spread(found.gain)} times the scans per second, {found.rounds} rounds in turn"
    table = _table(title, "", "scans per second", "latency p50 ms", "p95 ms")
    for name, fps, latency in (
        ("one by one", found.single_fps, found.single_latency_ms),
        ("stream", found.stream_fps, found.stream_latency_ms),
    ):
        table.add_row(name, f"{fps:.1f}", f"{latency.p50:.1f}", f"{latency.p95:.1f}")
    return table


def cold_line(found: ColdStart) -> str:
    """Return the times and the memory of a new process."""
    memory = found.detect_peak_memory_mib
    return (
        f"new process: {found.first_boxes_s:.2f} s to the first boxes (import {found.import_s:.2f}, load "
        f"{found.load_s:.2f}, first scan {found.first_scan_s:.2f}; median of {found.repeats})"
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


def _speed(one: Contestant) -> tuple[str, str, str, str]:
    return f"{one.total_ms.p50:.1f}", f"{one.total_ms.p95:.1f}", f"{one.fps:.1f}", _spread(one.speedup)


def _spread(ratio: Spread) -> str:
    return f"{ratio.median:.2f} ({ratio.low:.2f}-{ratio.high:.2f})"
