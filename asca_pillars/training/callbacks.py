"""Callbacks of a run: progress, Ctrl-C, the average of the weights, and its checkpoints.

Checkpoints are written whole; there are two generations of the last one, and the one to resume from is chosen here.
"""

import contextlib
import pickle
import shutil
import signal
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lightning as L  # noqa: N812  (Lightning's own convention)
import torch
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.pytorch.callbacks import Checkpoint, ModelCheckpoint, ProgressBar, WeightAveraging
from torch import Tensor

from asca_pillars.base.errors import TrainingError
from asca_pillars.base.files import atomic_path, require_content
from asca_pillars.base.progress import Reporter
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.config.tree import Config, ModelConfig
from asca_pillars.models.build import build_model, load_checkpoint
from asca_pillars.models.checkpoint_file import read_failure, read_plain, require_same_arrays

LAST, PREVIOUS, BEST = "last.ckpt", "previous.ckpt", "best.ckpt"
_UNREADABLE = (OSError, RuntimeError, ValueError, EOFError, KeyError, pickle.UnpicklingError, zipfile.BadZipFile)
_OTHERWISE_FILLED = (AttributeError, TypeError)  # from a dictionary with values of other types
_OF_A_RUN = {
    "state_dict": dict,
    "optimizer_states": list,
    "lr_schedulers": list,
    "loops": dict,
    "callbacks": dict,
    "epoch": int,
    "global_step": int,
    "pytorch-lightning_version": str,
}
"""Entries that a run resumes from; weights.ckpt holds only the weights."""
_WEIGHTS_ALONE = "holds weights alone, not the state of a run (weights.ckpt is such a file)"


class AtomicCheckpointIO(TorchCheckpointIO):
    """Checkpoints that a kill cannot leave half written; the last one before stays as previous.ckpt.

    Args:
        keep_last: whether the last.ckpt that is there is worth keeping; a damaged one is not.
    """

    def __init__(self, keep_last: bool) -> None:
        super().__init__()
        self.keep_last = keep_last

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None) -> None:
        """Write `checkpoint` to `path`."""
        path = Path(path)
        with atomic_path(path) as temporary:
            with temporary.open("wb") as file:  # given a path, torch raises no OSError on a full disk
                torch.save(checkpoint, file)
            if path.name == LAST:
                if self.keep_last and path.exists():
                    with atomic_path(path.with_name(PREVIOUS)) as previous:
                        shutil.copyfile(path, previous)  # not renamed: readers find a last.ckpt at every moment
                self.keep_last = True


class BestCheckpoint(ModelCheckpoint):
    """Saves best.ckpt when the validation loss is the lowest so far, over all that the run was stopped and resumed.

    Args:
        folder: of the checkpoints.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, filename="best", save_top_k=1, enable_version_counter=False, monitor="val/loss")

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Read the loss of the existing best.ckpt: the last checkpoint may be from before its validation."""
        super().on_train_start(trainer, pl_module)
        path = Path(str(self.dirpath)) / BEST
        if trainer.global_step and path.exists():
            with contextlib.suppress(*_UNREADABLE, *_OTHERWISE_FILLED):  # then the next validation replaces it
                state = read_plain(path)["callbacks"][self.state_key]
                # Lightning forgets the loss where the folder has another name: a run may have been moved.
                places = {"dirpath": self.dirpath, "best_model_path": str(path), "kth_best_model_path": str(path)}
                best = {str(path): loss for loss in state["best_k_models"].values()}
                self.load_state_dict({**state, **places, "best_k_models": best})


class LastCheckpoint(Checkpoint):
    """Saves last.ckpt every so many steps and with the last step of each epoch, before validation.

    It acts after everything else that a step changes: weights, their average, the schedule.

    Args:
        folder: of the checkpoints.
        every_steps: optimizer steps between two.
    """

    def __init__(self, folder: Path, every_steps: int) -> None:
        self.folder, self.every_steps = folder, every_steps

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Save if it is time."""
        if trainer.global_step % self.every_steps == 0 or trainer.is_last_batch:
            self.save(trainer)

    def save(self, trainer: L.Trainer) -> None:
        """Save now; between two steps of training only."""
        trainer.save_checkpoint(self.folder / LAST)


def checkpoint_to_resume(folder: Path, model: ModelConfig) -> tuple[Path | None, str | None]:
    """Return the newest checkpoint to resume from, None in a new run; and what is wrong with a newer one.

    Args:
        folder: of the run's checkpoints.
        model: of the run.

    Raises:
        TrainingError: there are checkpoints, but none to resume from.
    """
    unusable: list[str] = []
    weights = folder / BEST
    for path in (folder / LAST, folder / PREVIOUS):
        if not path.exists():
            continue
        require_content(path, TrainingError)
        if (reason := _unusable_reason(path, model)) is None:
            return path, unusable[0] if unusable else None
        unusable.append(f"{path} {reason}")
        weights = path if reason == _WEIGHTS_ALONE else weights
    if unusable:
        raise TrainingError(
            f"{unusable[0]} and there is no {PREVIOUS} to resume from; start a new run in another --out, "
            f"with the weights of this one if {weights} is there: --init {weights}"
        )
    return None, None


def _unusable_reason(path: Path, model: ModelConfig) -> str | None:
    """Return why a run of this model cannot resume from the checkpoint; None if it can."""
    try:
        content = read_plain(path)
    except _UNREADABLE as error:
        return f"is damaged ({read_failure(error)})"
    if "state_dict" not in content:
        return "is not a checkpoint of a run (no 'state_dict')"
    if any(name not in content for name in _OF_A_RUN):
        return _WEIGHTS_ALONE
    for name, kind in _OF_A_RUN.items():
        if not isinstance(content[name], kind):
            return f"is damaged (`{name}` is a {type(content[name]).__name__})"
    expected = {f"detector.{name}": array.shape for name, array in build_model(model).state_dict().items()}
    shapes = {name: getattr(array, "shape", None) for name, array in content["state_dict"].items()}
    if wrong := [name for name in expected if shapes.get(name) != expected[name]]:
        return f"is of another network ({wrong[0].removeprefix('detector.')} differs)"
    return None


def steps_of(checkpoint: Path | None) -> int:
    """Return the optimizer steps of a readable checkpoint; 0 without one."""
    if checkpoint is None:
        return 0
    return int(read_plain(checkpoint)["global_step"])


_FIRST_STAGE = tuple(f"network.{part}." for part in PvRcnnModel.FIRST_STAGE)


def initial_weights(config: Config, init: Path | None) -> dict[str, Any]:
    """Return the weights that a new run of `config` takes from `init`, as in `state_dict`; others start at random.

    These are all weights, or where `model.train_first_stage` is false, those of the first stage.

    Args:
        config: of the run.
        init: a checkpoint; None for none.

    Raises:
        TrainingError: they are not of this configuration's network, or none are given to a first stage that is not
            trained.
    """
    alone = isinstance(config.model, PvRcnnModel) and not config.model.train_first_stage
    if init is None:
        if alone:
            raise TrainingError(
                "model.train_first_stage = false: a first stage that is not trained has to come from somewhere; give "
                "the checkpoint or bundle of a trained one with --init"
            )
        return {}
    loaded, expected = (
        {name: array for name, array in weights.items() if not alone or name.startswith(_FIRST_STAGE)}
        for weights in (load_checkpoint(init).detector.state_dict(), build_model(config.model).state_dict())
    )
    remedy = "model.spec and model.network have to be like those that it was trained with"
    require_same_arrays(loaded, expected, init, "this configuration", remedy)
    return loaded


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
