"""The progress bar of `asca train`."""

from typing import Any

import lightning as L  # noqa: N812  (Lightning's own convention)
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from asca_pillars.training.callbacks import RankProgress


class RunProgress(RankProgress):
    """One bar over all steps of the run, so that the time that is left is that of the run.

    Args:
        console: console to draw on.
    """

    def __init__(self, console: Console) -> None:
        super().__init__()
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(elapsed_when_finished=True, compact=True),
            TextColumn("{task.fields[loss]}"),
            speed_estimate_period=600,
            console=console,
        )
        self._task = self._bar.add_task("Starting", total=None, loss="")

    def on_sanity_check_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Show that something happens from the first loader process on."""
        self._start("Checking validation")

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Set the length of the run."""
        total = (trainer.max_epochs or 0) * pl_module.steps_per_epoch()  # type: ignore[operator]
        self._start("Starting")
        self._bar.update(self._task, total=total, completed=trainer.global_step)

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Show the epoch, counted from one."""
        self._bar.update(self._task, description=f"Epoch {trainer.current_epoch + 1}/{trainer.max_epochs}")

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Advance by one step."""
        loss = trainer.progress_bar_metrics.get("loss")
        self._bar.update(
            self._task, completed=trainer.global_step, loss="" if loss is None else f"loss {float(loss):.3f}"
        )

    def on_validation_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *arguments: Any) -> None:
        """Show the progress of the validation beside the epoch."""
        if not trainer.sanity_checking:
            batches = sum(int(count) for count in trainer.num_val_batches)
            done = f"validation {arguments[2] + 1}/{batches}"
            self._bar.update(self._task, description=f"Epoch {trainer.current_epoch + 1}/{trainer.max_epochs}, {done}")

    def teardown(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Leave the bar as it is."""
        self._bar.stop()

    def on_exception(self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException) -> None:
        """Leave the bar as it is, or it would be drawn over the error."""
        self._bar.stop()

    def print(self, *args: Any, **_: Any) -> None:
        """Print a line above the bar."""
        if self._enabled:
            self._bar.console.print(" ".join(map(str, args)), markup=False, highlight=False, soft_wrap=True)

    def _start(self, what: str) -> None:
        if self._enabled:
            self._bar.update(self._task, description=what)
            self._bar.start()
