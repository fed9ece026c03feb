"""`asca train`: training by a YAML on a dataset, into a run's folder."""

from pathlib import Path
from typing import Annotated, Any

import typer

from asca_pillars.base.installation import require
from asca_pillars.cli.options import ConfigArgument, DataOption, InitOption, OverridesOption

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
    from asca_pillars.training.run_folder import require_own_run

    settings = load_config(config, override or ())
    require("train")
    require_own_run(out, init)
    console = Console(markup=False)
    init = None if init is None else find_checkpoint(init)
    with console.status("Loading PyTorch"):
        from asca_pillars.cli.progress import RunProgress
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
