"""The comparisons of `asca simulate`: with KITTI's statistics, and of simulated objects with real ones."""

from pathlib import Path

from rich.console import Console

from asca_deploy.open_model import RuntimeOptions, open_model
from asca_pillars.base.own_files import ending_with, is_own_picture, json_object, require_no_link, require_own
from asca_pillars.sim.report.comparison import compare, measure
from asca_pillars.sim.report.like_for_like import MIN_SCORE, compare_like_for_like
from asca_pillars.sim.report.like_tables import print_like, write_like
from asca_pillars.sim.report.plots import write_plots
from asca_pillars.sim.report.reference import kitti_reference
from asca_pillars.sim.report.tables import PAGE_END, print_comparison, write_report


def report_statistics(out: Path, console: Console) -> None:
    """Compare the frames below `out` with KITTI; print the tables and write them, and the plots, to out/report/."""
    folder = _claimed(out)
    reference = kitti_reference()
    measured = measure(out)
    comparison = compare(measured, reference.statistics)
    print_comparison(comparison, console)
    write_report(folder, comparison, write_plots(folder, comparison, measured, reference.sensor))
    console.print(f"All rows and plots: {folder}/report.md; all numbers: {folder}/report.json", soft_wrap=True)


def report_like_for_like(out: Path, like: Path, bundle: Path | None, console: Console) -> None:
    """Compare the objects below `out` with those of a real folder; print the tables and write them to out/report/."""
    folder = _claimed(out)
    detect = None if bundle is None else open_model(RuntimeOptions(bundle=bundle), MIN_SCORE).detect
    result = compare_like_for_like(like, out, detect, None if bundle is None else str(bundle))
    print_like(result, console)
    write_like(folder, result)
    console.print(f"Written: {folder}/like_for_like.md, .json and .png", soft_wrap=True)


def _claimed(out: Path) -> Path:
    """The folder of the reports, in which nothing but earlier ones is replaced; OutputError names anything else."""
    folder = out / "report"
    pictures = ("reflectance", "cars", "scans", "labels", "like_for_like")
    products = {
        "report.json": json_object("rows", "skipped", "simulated", "real"),
        "like_for_like.json": json_object("real", "simulated", "detector", "rows", "firing"),
        "report.md": ending_with(PAGE_END),
        "like_for_like.md": ending_with(PAGE_END),
        **{f"{name}.png": is_own_picture for name in pictures},
    }
    require_no_link(folder)
    require_own(folder, "asca simulate", products)
    return folder
