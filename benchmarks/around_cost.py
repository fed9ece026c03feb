"""Cost of a mounting and of detection in every direction: CPU time relative to that of the plain scan, in turn.

    python -m benchmarks.around_cost data/around/training/velodyne

The time is CPU time of all threads of the process, so other load has little effect. If rotating the points woke
threads other than the network's, it would show here: a mounting costs some percent,
and every direction as many times as there are passes.
"""

from pathlib import Path
from time import process_time
from typing import Annotated

import numpy as np
import typer

from asca_deploy import Detector
from asca_pillars.cli.run_command import run_command
from asca_pillars.scans.find_scans import find_scans
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_reader import read_scan


def main(
    scans: Annotated[Path, typer.Argument(help="Whole revolutions.")],
    bundle: Annotated[str | None, typer.Option("--bundle", "-b", help="Default: the one that ships.")] = None,
    frames: Annotated[int, typer.Option("--frames", "-n", help="Scans to time.")] = 40,
    threads: Annotated[int, typer.Option(help="CPU threads.")] = 1,
) -> None:
    """Print medians and quartiles over the scans."""
    detectors = {
        "ahead": Detector(bundle, threads=threads),
        "ahead, with a mounting": Detector(bundle, threads=threads, mounting=Mounting(sensor_height_m=1.9)),
        "around": Detector(bundle, threads=threads, view="around"),
    }
    times_ms = []
    for path in find_scans(scans)[:frames]:
        points = read_scan(path).points
        times_ms.append([_timed_ms(detector, points) for detector in detectors.values()])
    table = np.array(times_ms[1:])  # the first scan is the warm-up
    ratios = table / table[:, :1]
    print(f"{len(table)} scans, {threads} threads, CPU time of a scan")
    for (name, detector), times, ratio in zip(detectors.items(), table.T, ratios.T, strict=True):
        low, middle, high = np.percentile(ratio, [25, 50, 75])
        passes = f"{detector.passes} pass{'es'[: 2 * (detector.passes > 1)]}"
        print(
            f"{name}, {passes}: {np.median(times):.0f} ms, {middle:.2f} times the plain scan ({low:.2f} to {high:.2f})"
        )


def _timed_ms(detector: Detector, points: np.ndarray) -> float:
    start = process_time()
    detector(points)
    return (process_time() - start) * 1e3


if __name__ == "__main__":
    run_command(main)
