"""Training as a Python function; PyTorch is imported when it begins."""

from collections.abc import Sequence
from pathlib import Path

from asca_pillars.base.extras import require
from asca_pillars.base.progress import Progress, Remark
from asca_pillars.config.tree import Config, load_config


def train(
    config: str | Path | Config,
    data: str | Path,
    out: str | Path,
    *,
    override: Sequence[str] = (),
    devices: str = "auto",
    num_nodes: int = 1,
    init: str | Path | None = None,
    bar: bool = False,
    progress: Progress | None = None,
    remark: Remark | None = None,
) -> Path:
    """Train a detector, or go on where an interrupted run in `out` stopped.

    Args:
        config: YAML, the name of one that ships, or what `load_config` read.
        data: a dataset's folder.
        out: folder of the run.
        override: `key.subkey=value`, each wins over the YAML.
        devices: number of devices on this machine, or `auto`.
        num_nodes: machines that train together.
        init: checkpoint that a new run starts from.
        bar: draw a bar on the terminal and print remarks there, as `asca train` does.
        progress: called after each step, without `bar`.
        remark: called with the line of each validation and what is odd about the run, without `bar`.

    Returns:
        The last checkpoint.

    Raises:
        AscaError: as `training.loop.train`; of these TrainingInterruptedError after Ctrl-C, when the run is saved.
    """
    settings = config if isinstance(config, Config) else load_config(config, override)
    require("train")
    from asca_pillars.training.run_files import require_own_run

    init = None if init is None else Path(init)
    require_own_run(Path(out), init)
    from asca_pillars.training.callbacks import RunProgress, StepProgress
    from asca_pillars.training.loop import train as run

    remark_line = None if bar else remark or (lambda _: None)
    reporter = RunProgress() if remark_line is None else StepProgress(progress, remark_line)
    return run(settings, data, out, devices=devices, num_nodes=num_nodes, init=init, bar=reporter, remark=remark_line)
