"""`asca simulate`: a folder of labelled street scans or of short drives, and how like real ones the scans are."""

from pathlib import Path
from typing import Annotated

import typer

from asca_pillars.base.extras import require
from asca_pillars.cli.options import ClusterOption

FRAMES, LENGTH = 100, 100


def simulate(
    out: Annotated[Path, typer.Argument(help="Folder for the KITTI-layout dataset.")],
    *,
    frames: Annotated[
        int | None,
        typer.Option(
            "--frames",
            "-n",
            min=1,
            help=f"Frames to write. Default: {FRAMES}; with --report none where there are scans already.",
        ),
    ] = None,
    sequences: Annotated[
        int | None,
        typer.Option(
            "--sequences",
            min=1,
            help="Short drives at 10 Hz instead of single scans: the car and the road users move, boxes carry "
            "identities and velocities. Written as a dataset of boxes without a camera (docs/RECORDINGS.md).",
        ),
    ] = None,
    length: Annotated[
        int | None,
        typer.Option("--length", min=1, help=f"With --sequences: scans of each; 10 make a second. Default: {LENGTH}."),
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", min=0, help="Same seed, same bytes, whatever the number of workers.")
    ] = 0,
    workers: Annotated[int, typer.Option("--workers", "-w", min=1, help="Processes, without --cluster.")] = 2,
    cluster: ClusterOption = None,
    config: Annotated[
        str | None,
        typer.Option(
            "--config", "-c", help="YAML of scenes and sensor, or the name of one that ships. Default: KITTI's."
        ),
    ] = None,
    view: Annotated[
        str | None,
        typer.Option(
            "--view",
            help="full: 360 degrees, of which the camera's part is labelled, as in KITTI; around: 360 degrees, all "
            "of it labelled; camera: only what the camera sees, 6x smaller. Default: the config's; else full.",
        ),
    ] = None,
    val_share: Annotated[
        float, typer.Option("--val-share", min=0, max=1, help="Share of the frames listed in ImageSets/val.txt.")
    ] = 0.1,
    report: Annotated[
        bool,
        typer.Option(
            "--report",
            help="Compare the frames with KITTI's statistics: tables and plots in OUT/report/. "
            "Needs matplotlib, the extra eval: `asca doctor` says how to install it.",
        ),
    ] = False,
    like: Annotated[
        Path | None,
        typer.Option(
            "--like",
            help="Labelled real frames in KITTI's layout: compare each object in them with simulated ones at like "
            "distance, angle of view and occlusion; table, JSON and picture in OUT/report/. Needs matplotlib, too.",
        ),
    ] = None,
    bundle: Annotated[
        Path | None,
        typer.Option(
            "--bundle",
            "-b",
            help="With --like: also compare the scores that this bundle (or checkpoint) gives to real objects and "
            "their look-alikes, and how often it fires at what has no label.",
        ),
    ] = None,
) -> None:
    """Write simulated street scans with labels in KITTI's layout, and say how like real ones they are.

    With --report or --like, a folder that holds scans already, simulated or real, is compared as it is unless --frames
    is given.

    Examples:

    asca simulate data/sim -n 10000 --view camera

    asca simulate data/all -n 10000 --view around

    asca simulate data/drives --sequences 3 --length 200

    asca simulate /mnt/sim -n 1000000 --view camera --cluster 10.0.0.1:6379

    asca simulate data/sim --report --like data/kitti --bundle my_bundle
    """
    require("sim")
    if report or like is not None:
        require("eval")
    if cluster is not None:
        require("cluster")
    from rich.console import Console

    from asca_deploy.open_model import RuntimeOptions, open_model
    from asca_pillars.base.errors import ConfigError
    from asca_pillars.data.kitti import KittiSplit
    from asca_pillars.sim.simulation import load_simulation_config, require_own_frames
    from asca_pillars.sim.simulation import simulate as write_frames

    if bundle is not None and like is None:
        raise ConfigError(f"--bundle {bundle} scores the objects of a real folder: give --like FOLDER, too")
    if length is not None and sequences is None:
        raise ConfigError(f"--length {length} is for drives: give --sequences N, too, or --frames N for single scans")
    if like is not None:
        KittiSplit(like).frame_ids  # noqa: B018 - a wrong folder is named before the work
    if bundle is not None:
        open_model(RuntimeOptions(bundle=bundle), 0.0)  # and so is a wrong bundle
    console = Console(markup=False)
    settings = load_simulation_config(config, view)
    if sequences is not None:
        if frames is not None or report or like is not None or cluster is not None:
            raise ConfigError(
                "--sequences: leave --frames, --report, --like and --cluster out; they are for single scans"
            )
        from asca_pillars.sim.sequences.sequence_files import require_own_sequences, simulate_sequences

        length = length or LENGTH
        require_own_sequences(out)
        simulate_sequences(out, sequences, length, seed, workers, settings, val_share=val_share)
        console.print(f"{sequences} sequences of {length} scans below {out}; look at one: asca detect {out}/scans/0000")
        return
    there = any((out / "training" / "velodyne").glob("*.bin"))
    if frames is not None or not (there and (report or like is not None)):
        frames = frames or FRAMES
        require_own_frames(out)
        write_frames(out, frames, seed, workers, settings, val_share, cluster=cluster)
        console.print(f"{frames} frames below {out}; look at one: asca detect {out}/training/velodyne/000000.bin")
    if report:
        from asca_pillars.cli.simulate_reports import report_statistics

        report_statistics(out, console)
    if like is not None:
        from asca_pillars.cli.simulate_reports import report_like_for_like

        report_like_for_like(out, like, bundle, console)
