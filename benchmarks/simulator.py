"""Speed of the simulator, by number of processes.

    OMP_NUM_THREADS=1 python -m benchmarks.simulator --frames 60 --workers 1,2

Frames per second are of whole frames in memory, without writing them: by wall time, and per second of one core's
processor time, which hardly depends on other load. The first frames of each process, which compile or load the ray
caster, are left out.
"""

import multiprocessing
import os
import platform
import time
from dataclasses import replace
from functools import partial
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
import typer
from rich.console import Console
from rich.table import Table

from asca_pillars.base.processes import one_thread_per_process
from asca_pillars.cli.run_command import run_command
from asca_pillars.sim.simulation import SimulationConfig, simulate_frame

VIEWS: tuple[Literal["camera", "full"], ...] = ("camera", "full")
WARM_UP = 3
ROUNDS = 5


def main(
    frames: Annotated[int, typer.Option(help="Frames that are timed, per view and number of processes.")] = 60,
    workers: Annotated[str, typer.Option(help="Numbers of processes, by commas.")] = "1,2",
    seed: Annotated[int, typer.Option(help="Seed of the frames.")] = 0,
) -> None:
    """Print frames per second."""
    console = Console()
    console.print(
        f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
    )
    for view in VIEWS:
        config = replace(SimulationConfig(), field_of_view=view)
        table = Table(title=f"Frames per second, {view} view: median of {ROUNDS} rounds (slowest to fastest)")
        for column in ("processes", "all", "per process", "per second of processor time"):
            table.add_column(column, justify="right")
        for count in map(int, workers.split(",")):
            rates, busy = np.array(_rates(config, frames, seed, count)).T
            table.add_row(str(count), _spread(rates), f"{np.median(rates) / count:.1f}", _spread(busy))
        console.print(table)


def _spread(rates: npt.NDArray[np.float64]) -> str:
    return f"{np.median(rates):.1f} ({rates.min():.1f} to {rates.max():.1f})"


def _rates(config: SimulationConfig, frames: int, seed: int, workers: int) -> list[tuple[float, float]]:
    """Return the frames per second of `workers` processes together, and per second of processor time, of each round."""
    job = partial(_draw, config, seed)
    with one_thread_per_process(), multiprocessing.get_context("spawn").Pool(workers) as pool:
        pool.map(job, range(4 * WARM_UP * workers), chunksize=WARM_UP)
        rates = []
        for turn in range(ROUNDS):
            first, count = turn * frames, max(frames // ROUNDS, workers)
            start = time.perf_counter()
            busy = pool.map(job, range(first, first + count), chunksize=max(count // (4 * workers), 1))
            rates.append((count / (time.perf_counter() - start), count / sum(busy)))
        return rates


def _draw(config: SimulationConfig, seed: int, index: int) -> float:
    start = time.process_time()
    simulate_frame(seed, index, config)
    return time.process_time() - start


if __name__ == "__main__":
    run_command(main)
