"""`asca prepare` and `asca train`: training by a YAML on a dataset into a run's folder, and its caches before it."""

from pathlib import Path
from typing import Annotated, Any

import typer

from asca_pillars.base.installation import require
from asca_pillars.cli.options import ConfigArgument, DataOption, InitOption, OverridesOption


def prepare(
    config: ConfigArgument,
    *,
    data: DataOption,
    override: OverridesOption = None,
    kitti_split: Annotated[
        bool,
        typer.Option(
            "--kitti-split",
            help="Before that, write ImageSets/train.txt and val.txt with the 3,712 and 3,769 frames that papers train "
            "and validate on (Chen et al., 2015), for KITTI's 7,481 scans.",
            rich_help_panel="Output",
        ),
    ] = False,
    workers: Annotated[
        int, typer.Option("--workers", "-w", min=1, help="Processes.", metavar="N", rich_help_panel="Speed")
    ] = 2,
) -> None:
    """Compute once what training needs of a dataset.

    For GT-Aug and RS-Aug the object database and the maps of free ground, for a second stage the proposals of its
    first. Training does the same on first use; what is there and unchanged is used again. Without an insertion method
    in the config, what RS-Aug needs is prepared.
    """
    from rich.console import Console

    from asca_pillars.base.progress import Reporter
    from asca_pillars.cli.progress import Bars
    from asca_pillars.config.tree import load_config

    settings = load_config(config, override or ())
    console = Console(markup=False)
    if kitti_split:
        from asca_pillars.data.kitti.kitti_split import write_train_val_lists

        for path in write_train_val_lists(data):
            console.print(f"written: {path}", soft_wrap=True, highlight=False)
    require("train")
    from asca_pillars.training.dataset import prepare as run

    with Bars(console) as bars:
        inserter = run(settings, data, workers=workers, reporter=Reporter(bars))
    if inserter is None:
        return
    database, least = inserter.database, inserter.settings.min_points
    lines = [f"{database.path}: {len(database)} objects of {len(inserter.split.frame_ids)} frames"]
    for name, objects, share in zip(settings.model.spec.class_names, inserter.candidates, inserter.shares, strict=True):
        lines.append(f"  {name}: {len(objects)} with {least} or more points, drawn {share:.0%} of the time")
    console.print("\n".join(lines), soft_wrap=True, highlight=False)


INTERRUPTED = 130  # exit code of a command ended by Ctrl-C


def train(
    config: ConfigArgument,
    *,
    data: DataOption,
    override: OverridesOption = None,
    init: InitOption = None,
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", help="Folder of the run; an interrupted run there is resumed.", rich_help_panel="Output"
        ),
    ],
    devices: Annotated[
        str, typer.Option("--devices", help="Devices on this machine: a number or auto.", rich_help_panel="Speed")
    ] = "auto",
    num_nodes: Annotated[
        int,
        typer.Option(
            "--num-nodes",
            min=1,
            help="Machines that train together (torchrun or SLURM starts each).",
            metavar="N",
            rich_help_panel="Speed",
        ),
    ] = 1,
) -> None:
    """Train a detector; checkpoints, TensorBoard logs and the resolved config go to the run's folder.

    After Ctrl-C or a kill the same command resumes exactly from the last checkpoint.

    Example: asca train asca_small_sim --data data/sim --out runs/small -s train.batch_size=4
    """
    from rich.console import Console

    from asca_deploy.shipped import find_checkpoint
    from asca_pillars.cli.progress import Bars
    from asca_pillars.config.tree import load_config
    from asca_pillars.training.run_files import require_own_run

    settings = load_config(config, override or ())
    require("train")
    require_own_run(out, init)
    console = Console(markup=False)
    init = None if init is None else find_checkpoint(init)
    with console.status("Loading PyTorch"):
        from asca_pillars.cli.run_progress import RunProgress
        from asca_pillars.training.callbacks import TrainingInterruptedError
        from asca_pillars.training.train import train as run_training
    options: dict[str, Any] = {"devices": devices, "num_nodes": num_nodes, "init": init}
    try:
        with Bars(console, transient=True) as bars:
            run = RunProgress(console)
            last = run_training(settings, data, out, **options, progress=bars, remark=bars.remark, bar=run)
    except TrainingInterruptedError as stop:
        console.print(str(stop))
        raise typer.Exit(INTERRUPTED) from None
    console.print(f"Trained: {last}\nNext: asca export {last} -o {out / 'bundle'}")
