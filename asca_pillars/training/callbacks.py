"""Callbacks of a run: progress, Ctrl-C, the average of the weights."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from typing import Any

import lightning as L  # noqa: N812  (Lightning's own convention)
from lightning.pytorch.callbacks import Checkpoint, ProgressBar, WeightAveraging
from rich import progress as bars
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import Tensor

from asca_pillars.base.errors import TrainingError
from asca_pillars.base.progress import Progress, Remark
from asca_pillars.training.checkpoints import LastCheckpoint

_SIGNALS = (signal.SIGINT, signal.SIGTERM)  # Ctrl-C; what `kill`, systemd and batch systems send


class TrainingInterruptedError(TrainingError):
    """A stop was requested; the run is saved and can be resumed."""


class SaveOnInterrupt(Checkpoint):
    """Saves after the current step on the first Ctrl-C or SIGTERM, and stops; the second one stops at once.

    To Lightning alone SIGTERM is the end of a run that went well.

    A `Checkpoint`, because those act after everything else that a step changes.

    Args:
        last: what saves.
    """

    def __init__(self, last: LastCheckpoint) -> None:
        self.last = last
        self.stop_requested = False
        self._before: dict[int, Any] = {}

    @contextlib.contextmanager
    def listening(self) -> Iterator[None]:
        """Take over both signals, which only the main thread may, until Lightning has restored its own handlers."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        self._before = {number: signal.signal(number, self._request_stop) for number in _SIGNALS}
        try:
            yield
        finally:
            for number, handler in self._before.items():
                signal.signal(number, handler)

    def on_sanity_check_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """As `on_train_start`."""
        self._replace_lightnings_handlers()

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Take over the signals from Lightning, which has put its handler before ours.

        Its handler of SIGTERM broadcasts to the other ranks at once: in the middle of a backward pass, whose gradients
        they wait for, none of them ever goes on.
        """
        self._replace_lightnings_handlers()

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Save and stop, on all ranks together."""
        if self._any_rank_requested_stop(trainer):
            self.last.save(trainer)
            self._stop(trainer)

    def on_validation_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Stop: the epoch was saved before its validation."""
        if not trainer.sanity_checking and self._any_rank_requested_stop(trainer):
            self._stop(trainer)

    def _replace_lightnings_handlers(self) -> None:
        if not self.stop_requested:
            for number in self._before:
                signal.signal(number, self._request_stop)

    def _request_stop(self, number: int, *_: Any) -> None:
        self.stop_requested = True
        signal.signal(number, self._before[number])

    def _any_rank_requested_stop(self, trainer: L.Trainer) -> bool:
        return trainer.strategy.reduce_boolean_decision(self.stop_requested, all=False)

    def _stop(self, trainer: L.Trainer) -> None:
        raise TrainingInterruptedError(f"interrupted and saved at step {trainer.global_step}; the same command goes on")


class RankProgress(ProgressBar):
    """A bar that Lightning enables on the rank that prints, and disables on the others."""

    def __init__(self) -> None:
        super().__init__()
        self._enabled = True

    @property
    def is_enabled(self) -> bool:
        """True if this rank prints."""
        return self._enabled

    def disable(self) -> None:
        """Stay silent: called on the ranks that do not print."""
        self._enabled = False

    def enable(self) -> None:
        """Show progress: called on the rank that prints."""
        self._enabled = True


class RunProgress(RankProgress):
    """One bar over all steps of the run, so that the time that is left is that of the run."""

    def __init__(self) -> None:
        super().__init__()
        self._bar = bars.Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(elapsed_when_finished=True, compact=True),
            TextColumn("{task.fields[loss]}"),
            speed_estimate_period=600,
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


class StepProgress(RankProgress):
    """Calls `progress` after each step of the run, and draws nothing.

    Args:
        progress: None for none.
        remark: called with the line of each validation.
    """

    def __init__(self, progress: Progress | None, remark: Remark) -> None:
        super().__init__()
        self._progress, self._remark, self._total = progress, remark, 0

    def print(self, *args: Any, **_: Any) -> None:
        """Pass a line to `remark`."""
        if self._enabled:
            self._remark(" ".join(map(str, args)))

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Set the length of the run."""
        self._total = (trainer.max_epochs or 0) * pl_module.steps_per_epoch()  # type: ignore[operator]
        self._report_step(trainer)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Advance by one step."""
        self._report_step(trainer)

    def _report_step(self, trainer: L.Trainer) -> None:
        if self._progress is not None and self._enabled:
            self._progress("Training", trainer.global_step, self._total)


def weight_average(decay: float) -> WeightAveraging:
    """Return the exponential moving average of weights and normalization statistics, for validation and checkpoints.

    After n steps the decay is at most (1 + n) / (10 + n), so that random weights are forgotten in short runs, too.
    """

    def average(averaged: Tensor, current: Tensor, steps: Tensor | int) -> Tensor:
        kept = min(decay, float((1 + steps) / (10 + steps)))
        if not averaged.is_floating_point():  # batches that a normalization has counted
            return current
        return averaged + (current - averaged) * (1 - kept)  # constant values stay bit for bit

    return WeightAveraging(avg_fn=average)
