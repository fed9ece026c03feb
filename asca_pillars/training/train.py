"""Training as a Python function; PyTorch is imported when it begins."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from asca_pillars.base.installation import require
from asca_pillars.base.progress import Progress, Remark, Reporter
from asca_pillars.config.tree import Config, load_config

if TYPE_CHECKING:
    from lightning.pytorch.callbacks import ProgressBar


def train(
    config: str | Path | Config,
    data: str | Path,
    out: str | Path,
    *,
    override: Sequence[str] = (),
    devices: str = "auto",
    num_nodes: int = 1,
    init: str | Path | None = None,
    progress: Progress | None = None,
    remark: Remark | None = None,
    bar: "ProgressBar | None" = None,
) -> Path:
    """Train a detector, or resume an interrupted run in `out`.

    Args:
        config: YAML, the name of one that ships, or what `load_config` read.
        data: a dataset's folder.
        out: folder of the run.
        override: `key.subkey=value`, each wins over the YAML.
        devices: number of devices on this machine, or `auto`.
        num_nodes: machines that train together.
        init: checkpoint that a new run starts from.
        progress: called after each step, and before with what is prepared for the run.
        remark: called with the line of each validation, and what is odd about the run.
        bar: shows the steps and validations of the run in place of `progress` and `remark`.

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
    from asca_pillars.training.loop import train as run

    reporter = Reporter(progress, remark)
    return run(settings, data, out, devices=devices, num_nodes=num_nodes, init=init, bar=bar, reporter=reporter)
