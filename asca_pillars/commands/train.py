"""`asca train`: a YAML and a dataset in, a run's folder out."""

from pathlib import Path

import typer
from rich.console import Console

from asca_pillars.commands.extras import require
from asca_pillars.files import require_own

INTERRUPTED = 130  # what a shell says of a command that Ctrl-C ended


def run(
    config: Path, data: Path, out: Path, overrides: list[str], devices: str, num_nodes: int, init: Path | None
) -> None:
    """See `asca train --help`."""
    from asca_pillars.config import load_config

    settings = load_config(config, overrides)
    require("train")
    require_own(out, "asca train", "config.yaml", "environment.json", "train.log")  # the log is that of `asca ablate`
    console = Console(markup=False)
    with console.status("Loading PyTorch"):
        from asca_pillars.training.callbacks import TrainingInterruptedError
        from asca_pillars.training.loop import train
    try:
        last = train(settings, data, out, devices=devices, num_nodes=num_nodes, init=init)
    except TrainingInterruptedError as stop:
        console.print(str(stop))
        raise typer.Exit(INTERRUPTED) from None
    console.print(f"Trained: {last}\nNext: asca export {last} -o {out / 'bundle'}")
