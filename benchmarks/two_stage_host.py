"""What the second stage computes on the host: how long each step takes, compiled by numba.

    python -m benchmarks.two_stage_host [SCANS]...

Processor time of one thread, milliseconds, the best and the median of the rounds, so that other work on the machine
counts little. Each scan as it is within PV-RCNN's range, and as the camera sees it.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from asca_deploy import sample_scan_path
from asca_pillars.base.system import cpu_model
from asca_pillars.cli.run_command import run_command
from asca_pillars.evaluation.report_page import markdown_table
from asca_pillars.ops.points.neighbors import ball_query, nearest_in_cubes, three_nearest
from asca_pillars.ops.points.sampling import farthest_points, points_near_boxes
from asca_pillars.ops.two_stage.rois import roi_grid_points
from asca_pillars.scans.scan_reader import read_scan
from benchmarks.host_path import camera_view

RANGE_M = np.array([[0, 70.4], [-40, 40], [-3, 1]], np.float32)
BOXES, GRID = 50, 6
SAMPLES = 16
CUBE_CELLS = 3  # along each axis


def main(
    scans: Annotated[list[Path] | None, typer.Argument(help="KITTI .bin files; default: the one that ships.")] = None,
    rounds: Annotated[int, typer.Option(help="Rounds of each step.")] = 15,
) -> None:
    """Print a table for each scan."""
    print(f"{cpu_model()}, {rounds} rounds\n")
    for path in scans or [sample_scan_path()]:
        points = read_scan(path).points
        points = points[((points[:, :3] >= RANGE_M[:, 0]) & (points[:, :3] < RANGE_M[:, 1])).all(axis=1)]
        for view, part in (("whole range", points), ("camera view", points[camera_view(points)])):
            print(f"{path.name}, {view}: {len(part)} points")
            rows = [(name, *(f"{ms:.2f}" for ms in measure(step, rounds))) for name, step in steps(part).items()]
            print(markdown_table(("step", "best", "median"), rows, left=1) + "\n")


def steps(points: NDArray[np.float32]) -> dict[str, Callable[[], Any]]:
    """Name and call of each step, on boxes as large as cars that stand around points of the scan."""
    rng = np.random.default_rng(0)
    centers = points[rng.choice(len(points), BOXES), :3]
    sizes = np.tile(np.array([3.9, 1.6, 1.56], np.float32), (BOXES, 1))
    boxes = np.concatenate([centers, sizes, rng.uniform(-3, 3, (BOXES, 1)).astype(np.float32)], axis=1)
    close = points_near_boxes(points, boxes, 2.0)
    keypoints = points[farthest_points(points, 1024), :3]
    grid = roi_grid_points(boxes, GRID).reshape(-1, 3)

    def balls(source: NDArray[np.float32], queries: NDArray[np.float32], radius_m: float) -> Callable[[], Any]:
        return lambda: ball_query(source, queries, radius_m, SAMPLES)

    return {
        "farthest points, 2048": lambda: farthest_points(points, 2048),
        "farthest points, 1024": lambda: farthest_points(points, 1024),
        f"points near {BOXES} boxes": lambda: points_near_boxes(points, boxes, 2.0),
        f"farthest points, 1024 of {len(close)} near boxes": lambda: farthest_points(close, 1024),
        "balls of 1024 keypoints, 0.4 m": balls(points, keypoints, 0.4),
        "balls of 1024 keypoints, 0.8 m": balls(points, keypoints, 0.8),
        "three nearest of 1024 keypoints": lambda: three_nearest(keypoints, points),
        f"grids of {BOXES} boxes": lambda: roi_grid_points(boxes, GRID),
        f"balls of {len(grid)} grid points, 0.8 m": balls(keypoints, grid, 0.8),
        f"balls of {len(grid)} grid points, 1.6 m": balls(keypoints, grid, 1.6),
        f"cubes of {len(grid)} grid points, 0.8 m": lambda: nearest_in_cubes(keypoints, grid, 0.8, CUBE_CELLS),
        f"cubes of {len(grid)} grid points, 1.6 m": lambda: nearest_in_cubes(keypoints, grid, 1.6, CUBE_CELLS),
    }


def measure(step: Callable[[], Any], rounds: int) -> tuple[float, float]:
    """Best and median processor time of a call, milliseconds; the first is not counted."""
    times_ms = []
    for _ in range(rounds + 1):
        start = time.process_time()
        step()
        times_ms.append((time.process_time() - start) * 1e3)
    return min(times_ms[1:]), float(np.median(times_ms[1:]))


if __name__ == "__main__":
    run_command(main)
