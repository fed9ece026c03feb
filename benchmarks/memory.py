"""Growth of a detector's memory with the number of scans.

    python -m benchmarks.memory --scans 50000                  # half in calls, half in streams
    python -m benchmarks.memory --scans 50000 --only streams

Scans are crops of the sample of many sizes, so that everything whose size depends on the scan keeps changing. Half of
them are detected by single calls and half by streams that are opened and closed again.

Resident memory varies with the memory that the allocator returns, by some MiB and separately for each thread's arena,
so the difference of two samples is not conclusive. The crops repeat in the same order, and after CYCLE scans also at
the same places in a stream: the medians of whole cycles are compared. Leaks raise them.
"""

import json
import logging
from collections.abc import Iterator
from itertools import cycle, islice
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from asca_deploy import Detector, sample_scan_path
from asca_deploy.benchmark.bench_report import peak_memory_mib, resident_mib
from asca_deploy.providers import Precision, Provider
from asca_pillars.base.errors import AscaError
from asca_pillars.base.files import atomic_path
from asca_pillars.cli.run_command import run_command
from asca_pillars.scans.scan_reader import read_scan

CHUNK = 50  # scans of one stream, then as many single calls
CROPS = 199  # sizes that repeat, so that allocators reach a steady state; coprime to CHUNK
CYCLE = CHUNK * CROPS
WARM_SHARE = 0.2  # until the sizes of the allocator and the graphs are steady


def main(
    scans: Annotated[int, typer.Option(min=4 * CHUNK, help="Scans to run.")] = 10_000,
    bundle: Annotated[Path | None, typer.Option(help="Default: the one that ships.")] = None,
    provider: Annotated[Provider, typer.Option()] = "cpu",
    precision: Annotated[Precision, typer.Option(help="float32 or reduced.")] = "float32",
    threads: Annotated[int | None, typer.Option()] = None,
    only: Annotated[Literal["calls", "streams"] | None, typer.Option(help="Default: half of each.")] = None,
    out: Annotated[Path | None, typer.Option("--json", help="Also write the samples to this file.")] = None,
) -> None:
    """Run, sample the resident memory, print the growth from cycle to cycle, and the slope."""
    console = Console(markup=False, highlight=False)
    logging.getLogger("asca_pillars").setLevel(logging.ERROR)  # crops are unlike any training scan
    detector = Detector(bundle, provider=provider, precision=precision, threads=threads)
    samples = [(done, _resident()) for done in _run(detector, scans, only, console)]
    counts, resident = np.array(samples).T
    warm = counts >= WARM_SHARE * scans
    slope = np.polyfit(counts[warm], resident[warm], 1)[0] * 1000
    levels = cycle_levels(counts[warm], resident[warm])
    console.print(
        f"{scans} scans, {provider} {precision}: resident after the first {counts[warm][0]:.0f}, median of each cycle, "
        f"{', '.join(f'{level:.1f}' for level in levels)} MiB ({levels[-1] - levels[0]:+.2f}); "
        f"{resident[warm][0]:.1f} to {resident[-1]:.1f} from moment to moment, peak {peak_memory_mib():.1f}; "
        f"slope {slope:+.3f} MiB per 1,000 scans after the first {WARM_SHARE:.0%}",
        soft_wrap=True,
    )
    if out is not None:
        with atomic_path(out) as path:
            path.write_text(json.dumps({"scans": scans, "slope_mib_per_1000": slope, "samples": samples}) + "\n")


def cycle_levels(counts: NDArray[np.floating], resident: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the median resident memory, MiB, of each cycle of scans; of halves if there are less than two cycles.

    Args:
        counts: (N,) number of scans at each sample, ascending.
        resident: (N,) MiB at each sample.
    """
    cycles = max(2, round(float(counts[-1] - counts[0]) / CYCLE))
    return np.array([np.median(part) for part in np.array_split(resident, cycles)])


def _run(detector: Detector, count: int, only: str | None, console: Console) -> Iterator[int]:
    """Run `count` scans and yield after every CHUNK how many are done."""
    source = crops(read_scan(sample_scan_path()).points)
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("scans", total=count)
        for number, done in enumerate(range(0, count, CHUNK)):
            chunk = islice(source, min(CHUNK, count - done))
            streamed = only == "streams" or (only is None and number % 2 == 0)
            for _ in detector.stream(chunk) if streamed else map(detector, chunk):
                progress.advance(task)
            yield min(done + CHUNK, count)


def crops(points: NDArray[np.float32]) -> Iterator[NDArray[Any]]:
    """Yield without end CROPS squares of random place and size of a scan (N, 4), repeated."""
    rng = np.random.default_rng(0)
    for x, y, half in cycle(rng.uniform((0, -30, 1), (60, 30, 25), (CROPS, 3)).tolist()):
        yield points[(np.abs(points[:, 0] - x) < half) & (np.abs(points[:, 1] - y) < half)]


def _resident() -> float:
    resident = resident_mib()
    if resident is None:
        raise AscaError("this system does not say how much memory a process holds; run it on Linux")
    return resident


if __name__ == "__main__":
    run_command(main)
