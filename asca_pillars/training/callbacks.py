"""Callbacks of a run: progress, Ctrl-C, the average of the weights."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from typing import Any

import lightning as L  # noqa: N812  (Lightning's own convention)
from lightning.pytorch.callbacks import Checkpoint, ProgressBar, WeightAveraging
from torch import Tensor

from asca_pillars.base.errors import TrainingError
from asca_pillars.base.progress import Reporter
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
        they wait for, none of them ever continues.
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
        raise TrainingInterruptedError(
            f"interrupted and saved at step {trainer.global_step}; run the same command to resume"
        )


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


class StepProgress(RankProgress):
    """Tells a reporter of each step of the run and the line of each validation, and draws nothing."""

    def __init__(self, reporter: Reporter) -> None:
        super().__init__()
        self._reporter, self._total = reporter, 0

    def print(self, *args: Any, **_: Any) -> None:
        """Pass a line on as a remark."""
        if self._enabled:
            self._reporter.remark(" ".join(map(str, args)))

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Set the length of the run."""
        self._total = (trainer.max_epochs or 0) * pl_module.steps_per_epoch()  # type: ignore[operator]
        self._report_step(trainer)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Advance by one step."""
        self._report_step(trainer)

    def _report_step(self, trainer: L.Trainer) -> None:
        if self._enabled:
            self._reporter.progress("Training", trainer.global_step, self._total)


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
