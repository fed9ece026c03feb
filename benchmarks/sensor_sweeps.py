"""Comparison of a real sweep of another sensor with simulated ones: returns, ranges, reflectances, lasers.

    python -m benchmarks.sensor_sweeps SWEEP.pcd.bin -c hdl_32e           # nuScenes: float32 x, y, z, intensity, ring
    python -m benchmarks.sensor_sweeps SWEEP.feather -c vlp_32c_pair      # Argoverse 2; needs pyarrow

One sweep is one street: a difference in ranges may be of the places as well as of the sensors.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from asca_pillars.cli.run_command import run_command
from asca_pillars.sim.simulation import load_simulation_config, simulate_frame

NEAREST_M = 2.5  # nearer returns are mostly of the own car
BANDS_M = (10, 20, 30, 50)
UP_LIDAR_M = (1.35018, 0.0, 1.64042)  # Argoverse 2: the upper sensor in the vehicle's frame


def main(
    sweep: Annotated[Path, typer.Argument(help="A .pcd.bin of nuScenes or a .feather of Argoverse 2.")],
    config: Annotated[str, typer.Option("--config", "-c", help="Simulated sensor.")] = "hdl_32e",
    frames: Annotated[int, typer.Option(help="Simulated scans.")] = 12,
) -> None:
    """Print both sides."""
    settings = load_simulation_config(config, "full")
    simulated = [_describe(simulate_frame(0, index, settings).points) for index in range(frames)]
    real = _describe(read_sweep(sweep))
    table = Table(title=f"{sweep.name} beside {frames} scans of {config}")
    for column in ("", "real", "simulated", "lowest to highest"):
        table.add_column(column, justify="left" if not column else "right")
    for name, value in real.items():
        ours = [scan[name] for scan in simulated]
        table.add_row(name, f"{value:.3g}", f"{np.mean(ours):.3g}", f"{min(ours):.3g} to {max(ours):.3g}")
    Console().print(table)


def read_sweep(path: Path) -> NDArray[np.float32]:
    """Read points (N,4) of a sweep: x, y, z about the sensor, reflectance 0..0.99 (0..100 is divided by 100)."""
    if path.suffix == ".feather":
        from pyarrow import feather

        table = feather.read_table(path)
        columns = [table[name].to_numpy().astype(np.float32) for name in ("x", "y", "z", "intensity")]
        points = np.stack(columns, axis=1) - np.array([*UP_LIDAR_M, 0.0], np.float32)
    else:
        points = np.fromfile(path, np.float32).reshape(-1, 5)[:, :4]
    points[:, 3] = np.clip(points[:, 3] / 100.0, 0.0, 0.99)
    return points


def _describe(points: NDArray[np.float32]) -> dict[str, float]:
    distance = np.linalg.norm(points[:, :3], axis=1)
    points, distance = points[distance > NEAREST_M], distance[distance > NEAREST_M]
    reflectance = points[:, 3]
    rows = {"points beyond 2.5 m, thousands": len(points) / 1000}
    for low, high in zip((0, *BANDS_M), (*BANDS_M, 1000), strict=True):
        rows[f"share at {low}-{high} m" if high < 1000 else f"share beyond {low} m"] = float(
            np.mean((distance >= low) & (distance < high))
        )
    for share in (25, 50, 75, 95):
        rows[f"reflectance, {share} %"] = float(np.percentile(reflectance, share))
    rows["share of reflectance below 0.01"] = float(np.mean(reflectance < 0.01))
    return rows


if __name__ == "__main__":
    run_command(main)
