"""`asca bench`: where the milliseconds go, and on what machine."""

import json
from pathlib import Path

from rich.console import Console
from rich.table import Table

from asca_deploy import Detector, sample_scan_path
from asca_deploy.benchmark import BenchmarkReport, benchmark
from asca_pillars.data.scans import find_scans, read_scan
from asca_pillars.files import atomic_path


def run(
    scans: Path | None,
    bundle: Path | None,
    provider: str,
    precision: str | None,
    threads: int | None,
    rounds: int,
    report_path: Path | None,
) -> None:
    """See `asca bench --help`."""
    console = Console(markup=False)
    points = [read_scan(path).points for path in find_scans(sample_scan_path() if scans is None else scans)]
    detector = Detector(bundle, provider=provider, precision=precision, threads=threads)
    with console.status(f"{rounds} rounds over {len(points)} scan(s)"):
        report = benchmark(detector, points, rounds=rounds)
    console.print(_table(report))
    memory = "" if report.peak_memory_mib is None else f", peak memory {report.peak_memory_mib:.0f} MiB"
    cold = "" if report.cold_ms is None else f", first scan {report.cold_ms:.0f} ms"
    console.print(f"{report.fps:.1f} FPS; loaded in {report.load_s:.2f} s{cold}{memory}")
    versions = ", ".join(f"{name} {version}" for name, version in report.versions.items())
    console.print(f"{report.cpu}, {report.threads} threads, {report.provider}; {versions}")
    if report_path is not None:
        with atomic_path(report_path) as temporary:
            temporary.write_text(json.dumps(report.to_dict(), indent=1) + "\n", encoding="utf-8")


def _table(report: BenchmarkReport) -> Table:
    points = f"{min(report.points)}" if len(set(report.points)) == 1 else f"{min(report.points)}-{max(report.points)}"
    table = Table(title=f"{report.bundle}: {report.frames} warm frames, {report.scans} scan(s) of {points} points")
    for column in ("stage", "p50 ms", "p95 ms", "min ms"):
        table.add_column(column, justify="left" if column == "stage" else "right")
    for name, times in [*report.stages_ms.items(), ("total", report.total_ms)]:
        table.add_row(name, f"{times.p50:.2f}", f"{times.p95:.2f}", f"{times.min:.2f}")
    return table
