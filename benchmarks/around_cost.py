"""What looking in every direction costs, in passes: CPU time of `view="around"` over that of `view="ahead"`.

    python -m benchmarks.around_cost data/around/training/velodyne

Both run in turn on the same scans, and the time is that of the process' own work: a busy machine does not change it.
"""

from pathlib import Path
from time import process_time
from typing import Annotated

import numpy as np
import typer

from asca_deploy import Detector
from asca_pillars.commands.run_command import run_command
from asca_pillars.data.scans.find_scans import find_scans
from asca_pillars.data.scans.scan_reader import read_scan


def main(
    scans: Annotated[Path, typer.Argument(help="Whole revolutions.")],
    bundle: Annotated[str | None, typer.Option("--bundle", "-b", help="Default: the one that ships.")] = None,
    frames: Annotated[int, typer.Option("--frames", "-n", help="Scans to time.")] = 40,
    threads: Annotated[int, typer.Option(help="CPU threads.")] = 1,
) -> None:
    """Print the median and quartiles over the scans."""
    ahead, around = (Detector(bundle, view=view, threads=threads) for view in ("ahead", "around"))
    times_ms = []
    for path in find_scans(scans)[:frames]:
        points = read_scan(path).points
        times_ms.append([_timed_ms(detector, points) for detector in (ahead, around)])
    table = np.array(times_ms[1:])  # the first scan warms up
    ratio = table[:, 1] / table[:, 0]
    low, middle, high = np.percentile(ratio, [25, 50, 75])
    one, all_ = np.median(table, axis=0)
    print(f"{len(table)} scans, {threads} threads: ahead {one:.0f} ms, around {all_:.0f} ms of CPU time")
    print(f"{around.passes} passes cost {middle:.2f} times one (quartiles {low:.2f} to {high:.2f})")


def _timed_ms(detector: Detector, points: np.ndarray) -> float:
    start = process_time()
    detector(points)
    return (process_time() - start) * 1e3


if __name__ == "__main__":
    run_command(main)
