"""`asca simulate`: a folder of labelled simulated scans or short drives, and reports of their realism."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asca_pillars.base.installation import require
from asca_pillars.cli.options import ClusterOption

if TYPE_CHECKING:
    from rich.console import Console

FRAMES, LENGTH = 100, 100


def simulate(
    out: Annotated[Path, typer.Argument(help="Folder for the KITTI-layout dataset.")],
    *,
    config: Annotated[
        str | None,
        typer.Option(
            "--config",
            "-c",
            help="YAML of scenes and sensor, or the name of one that ships. Default: KITTI's.",
            rich_help_panel="Input",
        ),
    ] = None,
    like: Annotated[
        Path | None,
        typer.Option(
            "--like",
            help="Labelled real frames in KITTI's layout: compare each object in them with simulated ones at like "
            "distance, angle of view and occlusion; table, JSON and picture in OUT/report/. Needs matplotlib, too.",
            rich_help_panel="Input",
        ),
    ] = None,
    bundle: Annotated[
        Path | None,
        typer.Option(
            "--bundle",
            "-b",
            help="With --like: also compare the scores that this bundle (or checkpoint) gives to real objects and "
            "the simulated ones paired with them, and its false positives per frame.",
            rich_help_panel="Input",
        ),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(
            "--frames",
            "-n",
            min=1,
            help=f"Frames to write. Default: {FRAMES}; with --report none where there are scans already.",
            metavar="N",
            rich_help_panel="Scenes",
        ),
    ] = None,
    sequences: Annotated[
        int | None,
        typer.Option(
            "--sequences",
            min=1,
            help="Short drives at 10 Hz instead of single scans: the car and the road users move, boxes carry "
            "identities and velocities. Written as a dataset of boxes without a camera (docs/RECORDINGS.md).",
            metavar="N",
            rich_help_panel="Scenes",
        ),
    ] = None,
    length: Annotated[
        int | None,
        typer.Option(
            "--length",
            min=1,
            help=f"With --sequences: scans of each; 10 make a second. Default: {LENGTH}.",
            metavar="N",
            rich_help_panel="Scenes",
        ),
    ] = None,
    seed: Annotated[
        int,
        typer.Option(
            "--seed",
            min=0,
            help="Same seed, same bytes, whatever the number of workers.",
            metavar="N",
            rich_help_panel="Scenes",
        ),
    ] = 0,
    view: Annotated[
        str | None,
        typer.Option(
            "--view",
            help="full: 360 degrees, of which the camera's part is labelled, as in KITTI; around: 360 degrees, all "
            "of it labelled; camera: only what the camera sees, 6x smaller. Default: the config's; else full.",
            rich_help_panel="Scenes",
        ),
    ] = None,
    val_share: Annotated[
        float,
        typer.Option(
            "--val-share",
            min=0,
            max=1,
            help="Share of the frames listed in ImageSets/val.txt.",
            metavar="SHARE",
            rich_help_panel="Output",
        ),
    ] = 0.1,
    report: Annotated[
        bool,
        typer.Option(
            "--report",
            help="Compare the frames with KITTI's statistics: tables and plots in OUT/report/. "
            "Needs matplotlib, the extra eval: `asca doctor` says how to install it.",
            rich_help_panel="Output",
        ),
    ] = False,
    workers: Annotated[
        int,
        typer.Option(
            "--workers", "-w", min=1, help="Processes, without --cluster.", metavar="N", rich_help_panel="Speed"
        ),
    ] = 2,
    cluster: ClusterOption = None,
) -> None:
    """Write simulated street scans with labels in KITTI's layout, and compare them with real ones.

    With --report or --like, a folder that holds scans already, simulated or real, is compared as it is unless --frames
    is given.

    Examples:

    asca simulate data/sim -n 10000 --view camera

    asca simulate data/all -n 10000 --view around

    asca simulate data/drives --sequences 3 --length 200

    asca simulate /mnt/sim -n 1000000 --view camera --cluster 10.0.0.1:6379

    asca simulate data/sim --report --like data/kitti --bundle my_bundle
    """
    if report or like is not None:
        require("eval")
    from rich.console import Console

    from asca_pillars.base.errors import ConfigError
    from asca_pillars.cli.progress import Bars
    from asca_pillars.data.kitti import KittiSplit
    from asca_pillars.sim.simulate import simulate as run

    if bundle is not None and like is None:
        raise ConfigError(f"--bundle {bundle} scores the objects of a real folder: give --like FOLDER, too")
    if sequences is not None and (frames is not None or report or like is not None or cluster is not None):
        raise ConfigError("--sequences: leave --frames, --report, --like and --cluster out; they are for single scans")
    if like is not None:
        KittiSplit(like).frame_ids  # noqa: B018 - a wrong folder is named before the work
    if bundle is not None:
        from asca_deploy.open_model import RuntimeOptions, open_model

        open_model(RuntimeOptions(bundle=bundle), 0.0)  # likewise a wrong bundle
    console = Console(markup=False)
    has_scans = any((out / "training" / "velodyne").glob("*.bin"))
    if sequences is not None or frames is not None or not (has_scans and (report or like is not None)):
        with Bars(console) as bars:
            done = run(
                out,
                frames,
                sequences=sequences,
                length=length,
                seed=seed,
                workers=workers,
                config=config,
                view=view,  # type: ignore[arg-type]  # it is checked with the config
                val_share=val_share,
                cluster=cluster,
                progress=bars,
                remark=bars.remark,
            )
        if sequences is None:
            console.print(f"{done.frames} frames below {out}; look at one: asca detect {done.scans}/000000.bin")
        else:
            what = f"{sequences} sequences of {done.frames // sequences} scans"
            console.print(f"{what} below {out}; look at one: asca detect {out}/scans/0000")
    if report:
        _report_statistics(out, console)
    if like is not None:
        _report_like_for_like(out, like, bundle, console)


def _report_statistics(out: Path, console: "Console") -> None:
    """Compare the frames below `out` with KITTI; print the tables and write them, and the plots, to out/report/."""
    from asca_pillars.base.progress import Reporter
    from asca_pillars.cli.progress import Bars
    from asca_pillars.sim.report.comparison import compare, measure
    from asca_pillars.sim.report.plots import write_plots
    from asca_pillars.sim.report.reference import kitti_reference
    from asca_pillars.sim.report.tables import print_comparison, write_report

    folder = _report_folder(out)
    reference = kitti_reference()
    with Bars(console) as bars:
        measured = measure(out, reporter=Reporter(bars))
    comparison = compare(measured, reference.statistics)
    print_comparison(comparison, console)
    write_report(folder, comparison, write_plots(folder, comparison, measured, reference.sensor))
    console.print(f"All rows and plots: {folder}/report.md; all numbers: {folder}/report.json", soft_wrap=True)


def _report_like_for_like(out: Path, like: Path, bundle: Path | None, console: "Console") -> None:
    """Compare the objects below `out` with those of a real folder; print the tables and write them to out/report/."""
    from asca_deploy.open_model import RuntimeOptions, open_model
    from asca_pillars.base.progress import Reporter
    from asca_pillars.cli.progress import Bars
    from asca_pillars.sim.report.like_for_like import MIN_SCORE, compare_like_for_like
    from asca_pillars.sim.report.like_tables import print_like, write_like

    folder = _report_folder(out)
    detect = None if bundle is None else open_model(RuntimeOptions(bundle=bundle), MIN_SCORE).detect
    with Bars(console) as bars:
        name = None if bundle is None else str(bundle)
        result = compare_like_for_like(like, out, detect, name, Reporter(bars))
    print_like(result, console)
    write_like(folder, result)
    console.print(f"Written: {folder}/like_for_like.md, .json and .png", soft_wrap=True)


def _report_folder(out: Path) -> Path:
    """Return the folder of the reports, which may contain earlier ones only; else OutputError names the first other."""
    from asca_pillars.base.own_files import ending_with, is_own_picture, json_object, require_no_link, require_own
    from asca_pillars.sim.report.tables import PAGE_END

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
