"""Speed of the simulator, by stage and by number of processes.

    OMP_NUM_THREADS=1 python -m benchmarks.simulator --frames 60 --workers 1,2

Stages are those of `simulate_frame`, in milliseconds of processor time on one core, so that other load has little
effect (and linear algebra does not use every core, see OMP_NUM_THREADS): median, and the 5th and 95th percentile over
the frames. Frames per second are of whole frames in memory, without writing them: by wall time, and per second of one
core's processor time, which hardly depends on other load. The first frames of each process, which
compile or load the ray caster, are left out.
"""

import multiprocessing
import os
import platform
import time
from collections import defaultdict
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
from asca_pillars.data.kitti import in_image
from asca_pillars.sim.annotation import label_camera_view
from asca_pillars.sim.casting.raycast import cast
from asca_pillars.sim.sensor.lidar import draw_firings
from asca_pillars.sim.sensor.returns import measure
from asca_pillars.sim.simulation import RAY_KEYS, SimulationConfig, built_half_angle_rad, outside_image, simulate_frame
from asca_pillars.sim.world.scene import build, draw_scene
from asca_pillars.sim.world.streets import draws_of

STAGES = ("scene", "bodies", "cast", "returns", "labels", "frame")
VIEWS: tuple[Literal["camera", "full"], ...] = ("camera", "full")
WARM_UP = 3
ROUNDS = 5


def main(
    frames: Annotated[int, typer.Option(help="Frames that are timed, per view and number of processes.")] = 60,
    workers: Annotated[str, typer.Option(help="Numbers of processes, by commas; empty: stages alone.")] = "1,2",
    seed: Annotated[int, typer.Option(help="Seed of the frames.")] = 0,
) -> None:
    """Print frames per second and milliseconds per stage."""
    console = Console()
    console.print(
        f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
    )
    counts = [int(count) for count in workers.split(",") if count]
    for view in VIEWS:
        config = replace(SimulationConfig(), field_of_view=view)
        console.print(_stage_table(view, _stages(config, frames, seed)))
        if not counts:
            continue
        table = Table(title=f"Frames per second, {view} view: median of {ROUNDS} rounds (slowest to fastest)")
        for column in ("processes", "all", "per process", "per second of processor time"):
            table.add_column(column, justify="right")
        for count in counts:
            rates, busy = np.array(_rates(config, frames, seed, count)).T
            table.add_row(str(count), _spread(rates), f"{np.median(rates) / count:.1f}", _spread(busy))
        console.print(table)


def _stages(config: SimulationConfig, frames: int, seed: int) -> dict[str, list[float]]:
    """Return the milliseconds of processor time of each frame, by stage."""
    spent: dict[str, list[float]] = defaultdict(list)
    for index in range(frames + WARM_UP):
        marks = [time.process_time()]
        camera_only = config.field_of_view == "camera"
        scene = draw_scene(config.scene, draws_of(seed, index, 0))
        marks.append(time.process_time())
        bodies = build(scene, config.scene, (seed, index), built_half_angle_rad(config))
        marks.append(time.process_time())
        firings = draw_firings(config.lidar, draws_of(seed, index, 2), camera_only)
        if camera_only:
            firings = replace(firings, outside=outside_image(firings, scene.calibration))
        noise = draws_of(seed, index, 3)
        hits = cast(bodies, len(scene.targets), scene.ground, firings, int(noise.integers(RAY_KEYS)))
        marks.append(time.process_time())
        returns = measure(hits, firings, noise)
        marks.append(time.process_time())
        seen = in_image(returns.points, scene.calibration)
        label_camera_view(scene.targets, hits, returns.owner[seen], scene.calibration, config.scene)
        marks.append(time.process_time())
        if index >= WARM_UP:
            steps = [*np.diff(marks), marks[-1] - marks[0]]
            for stage, seconds in zip(STAGES, steps, strict=True):
                spent[stage].append(1e3 * float(seconds))
    return spent


def _stage_table(view: str, spent: dict[str, list[float]]) -> Table:
    table = Table(title=f"Milliseconds per frame on one core, {view} view")
    for column in ("stage", "median", "p5", "p95"):
        table.add_column(column, justify="right")
    for stage in STAGES:
        table.add_row(stage, *(f"{np.percentile(spent[stage], share):.1f}" for share in (50, 5, 95)))
    return table


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
