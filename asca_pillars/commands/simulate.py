"""`asca simulate`: a folder of labelled street scans, for tools that read KITTI, and how like real ones they are."""

from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from asca_pillars.commands.extras import require
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.errors import ConfigError
from asca_pillars.files import require_own

if TYPE_CHECKING:
    from asca_pillars.sim.report.like_for_like import Detect

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
    like: Path | None = None,
    bundle: Path | None = None,
) -> None:
    """See `asca simulate --help`."""
    require("sim")
    if bundle is not None and like is None:
        raise ConfigError(f"--bundle {bundle} scores the objects of a real folder: give --like FOLDER, too")
    if report or like is not None:
        require("eval")
    if like is not None:
        KittiSplit(like).frame_ids  # noqa: B018 - a wrong folder is told before the work
    detect = None if bundle is None else _open_detector(bundle)
    from asca_pillars.sim.simulation import simulate
    from asca_pillars.sim.simulation_configs import load_simulation_config

    console = Console(markup=False)
    config = load_simulation_config(config_path, view)
    if frames is not None or not ((report or like) and any((out / "training" / "velodyne").glob("*.bin"))):
        frames = frames or FRAMES
        require_own(out, "asca simulate", "simulation.json", text='"seed"')
        simulate(out, frames, seed, workers, config, val_share)
        console.print(f"{frames} frames below {out}; look at one: asca detect {out}/training/velodyne/000000.bin")
    if report:
        _report(out, console)
    if like is not None:
        _compare_like(out, like, detect, None if bundle is None else str(bundle), console)


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


def _open_detector(bundle: Path) -> "Detect":
    from asca_pillars.commands.models import open_model
    from asca_pillars.sim.report.like_for_like import MIN_SCORE

    return open_model(bundle, MIN_SCORE, "cpu", None, None).detect


def _compare_like(out: Path, like: Path, detect: "Detect | None", detector: str | None, console: Console) -> None:
    """Compare the objects below `out` with those of a real folder; print the tables and write them to out/report/."""
    from asca_pillars.sim.report.like_for_like import compare_like_for_like
    from asca_pillars.sim.report.like_tables import print_like, write_like

    result = compare_like_for_like(like, out, detect, detector)
    print_like(result, console)
    write_like(out / "report", result)
    console.print(f"Written: {out}/report/like_for_like.md, .json and .png", soft_wrap=True)
