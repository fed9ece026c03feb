"""`asca simulate`: a folder of labelled street scans, for tools that read KITTI, and how like real ones they are."""

from pathlib import Path

from rich.console import Console

from asca_pillars.commands.extras import require
from asca_pillars.files import require_own

FRAMES = 100


def run(
    out: Path,
    frames: int | None,
    seed: int,
    workers: int,
    config_path: str | None,
    view: str | None,
    val_share: float,
    report: bool,
) -> None:
    """See `asca simulate --help`."""
    require("sim")
    if report:
        require("eval")
    from asca_pillars.sim.simulation import simulate
    from asca_pillars.sim.simulation_configs import load_simulation_config

    console = Console(markup=False)
    config = load_simulation_config(config_path, view)
    if frames is not None or not (report and any((out / "training" / "velodyne").glob("*.bin"))):
        frames = frames or FRAMES
        require_own(out, "asca simulate", "simulation.json", text='"seed"')
        simulate(out, frames, seed, workers, config, val_share)
        console.print(f"{frames} frames below {out}; look at one: asca detect {out}/training/velodyne/000000.bin")
    if report:
        _report(out, console)


def _report(out: Path, console: Console) -> None:
    """Compare the frames below `out` with KITTI; print the tables and write them, and the plots, to out/report/."""
    from asca_pillars.sim.report.comparison import compare
    from asca_pillars.sim.report.measured import measure
    from asca_pillars.sim.report.plots import write_plots
    from asca_pillars.sim.report.reference import kitti_reference
    from asca_pillars.sim.report.tables import print_comparison, write_report

    folder = out / "report"
    require_own(folder, "asca simulate --report", "report.json", "reflectance.png")
    reference = kitti_reference()
    measured = measure(out)
    comparison = compare(measured, reference.statistics)
    print_comparison(comparison, console)
    write_report(folder, comparison, write_plots(folder, comparison, measured, reference.sensor))
    console.print(f"All rows and plots: {folder}/report.md; all numbers: {folder}/report.json", soft_wrap=True)
