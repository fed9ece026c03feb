"""`asca simulate`: a folder of labelled street scans, for tools that read KITTI."""

from pathlib import Path

from rich.console import Console

from asca_pillars.commands.extras import require


def run(out: Path, frames: int, seed: int, workers: int, view: str, val_share: float) -> None:
    """See `asca simulate --help`."""
    require("sim")
    from asca_pillars.schema import parse
    from asca_pillars.sim.simulate import SimulationConfig, simulate

    config = parse(SimulationConfig, {"field_of_view": view}, "--view")
    simulate(out, frames, seed, workers, config, val_share)
    Console(markup=False).print(
        f"{frames} frames below {out}; look at one: asca detect {out}/training/velodyne/000000.bin"
    )
