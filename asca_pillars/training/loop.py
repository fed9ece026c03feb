"""Training on Lightning, which does launching, devices and the loop itself."""

import logging
import warnings
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import lightning as L  # noqa: N812  (Lightning's own convention)
import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.fabric.utilities.rank_zero import rank_zero_only
from lightning.fabric.utilities.warnings import PossibleUserWarning
from lightning.pytorch.callbacks import Callback, LearningRateMonitor, ProgressBar
from lightning.pytorch.loggers import TensorBoardLogger

from asca_pillars.base.errors import TrainingError
from asca_pillars.base.files import WEIGHTS_FILE
from asca_pillars.base.locks import only_writer, recover
from asca_pillars.base.progress import Reporter
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import Config, ModelConfig, TrainConfig
from asca_pillars.config.two_stage import RefineModel
from asca_pillars.data.open_split import open_split
from asca_pillars.models.checkpoint_file import save_weights
from asca_pillars.models.pillar.trained import Distillation
from asca_pillars.models.two_stage.first_stage import with_first_stage
from asca_pillars.training.callbacks import (
    LAST,
    AtomicCheckpointIO,
    BestCheckpoint,
    LastCheckpoint,
    SaveOnInterrupt,
    StepProgress,
    checkpoint_to_resume,
    initial_weights,
    steps_of,
    weight_average,
)
from asca_pillars.training.dataset import require_boxes
from asca_pillars.training.loaders import DetectionData
from asca_pillars.training.module import DetectionModule, has_bfloat16, resolve_precision
from asca_pillars.training.run_files import COMMAND
from asca_pillars.training.run_folder import TrainingInputs, measure_input, prepare_run_folder, recorded_precision

SANITY_STEPS = 2  # validation batches that run before the first training step


def train(
    config: Config,
    data_root: str | Path,
    out: str | Path,
    *,
    devices: str = "auto",
    num_nodes: int = 1,
    init: Path | None = None,
    bar: ProgressBar | None = None,
    reporter: Reporter | None = None,
) -> Path:
    """Train `config` on a dataset, or resume an interrupted run in `out`.

    `out` receives config.yaml (resolved), environment.json, frames.json, expected_input.yaml, TensorBoard logs and
    checkpoints/{last,previous,best,weights}.ckpt.

    Args:
        config: what to train.
        data_root: a dataset's folder, see `data.open_split`.
        out: folder of this run; one run with the same config in it is resumed exactly. With the `step` schedule,
            and with `warmup_stable_decay` until its rate falls, it may be made longer by more `train.epochs`, and is
            then what the longer run would have been. A run there that has no checkpoint yet gives way.
        devices: number of devices on this machine, or `auto`.
        num_nodes: machines that train together, each started with the same command (torchrun, SLURM).
        init: checkpoint that a new run starts from, see `initial_weights`; a resumed run must have started from
            them.
        bar: shows the steps and validations of the run; None: the reporter is told of them.
        reporter: told of what comes before, and of what is odd about the run; None for none.

    Returns:
        The last checkpoint.

    Raises:
        TrainingError: `out` holds a run with another config or on other frames, or only damaged checkpoints, `init` is
            another network, or missing where it is needed, the devices are not there, or a loss became infinite or
            NaN.
        TrainingInterruptedError: Ctrl-C; the run is saved.
        OutputError: another process trains in `out`.
        DatasetError, ScanError: the data cannot be read, or no training frame has a box of any class.
        BundleError, ExportError, ConfigError: the first stage of two, or the teacher, cannot be used.
    """
    # The processes of one run share its folder: the first holds it.
    with only_writer(out, COMMAND) if getattr(rank_zero_only, "rank", 0) == 0 else nullcontext():
        return _train(config, data_root, Path(out), devices, num_nodes, init, bar=bar, reporter=reporter or Reporter())


def _train(
    config: Config,
    data_root: str | Path,
    out: Path,
    devices: str,
    num_nodes: int,
    init: Path | None,
    *,
    bar: ProgressBar | None,
    reporter: Reporter,
) -> Path:
    if isinstance(config.model, RefineModel):
        config = replace(config, model=with_first_stage(config.model))
    checkpoints = out / "checkpoints"
    # The recorded configuration must hold for the checkpoint: without a camera, training uses whole scans.
    view = config.data.camera_view and open_split(data_root).has_camera
    config = replace(config, data=replace(config.data, camera_view=view))
    recover(checkpoints)
    resumed, damage = checkpoint_to_resume(checkpoints, config.model)
    resumes = resumed is not None
    config = replace(config, train=_with_resolved_precision(config.train, out, resumes=resumes))
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    # Arguments are checked before minutes of work, and before the folder is claimed for this run.
    weights = None if resumes and init is None else initial_weights(config, init)
    distillation = Distillation(config, config.train.teacher) if config.train.teacher else None
    files = AtomicCheckpointIO(keep_last=damage is None)
    last = LastCheckpoint(checkpoints, config.train.checkpoint_steps)
    interrupt = SaveOnInterrupt(last)
    callbacks = [StepProgress(reporter) if bar is None else bar, last, interrupt]
    trainer = _trainer(config, out, files, callbacks, int(devices) if devices.isdigit() else devices, num_nodes)
    if not trainer.is_global_zero:
        reporter = Reporter()  # one process speaks for all
    for name, training in ((config.data.train_set, True), (config.data.val_set, False)):
        split = open_split(data_root, name)
        split.require_files()
        for warning in require_boxes(split, config, training=training, reporter=reporter):
            reporter.remark(warning)
    data = DetectionData(config, data_root, reporter)
    inputs = TrainingInputs.of(data.training_set.frames.split, trainer.world_size, weights)
    prepare_run_folder(out, config, inputs, steps_of(resumed))
    if damage is not None and resumes:
        reporter.remark(f"{damage}: resuming from {resumed}")
    if config.train.precision == "bf16" and not has_bfloat16():
        remedy = f"resume where {out} was started, or start anew with --init" if resumes else "choose auto or fp32"
        reporter.remark(f"train.precision = bf16: this device has no bfloat16 and is many times slower in it; {remedy}")
    L.seed_everything(config.train.seed, verbose=False)
    keep = resumes or not trainer.is_global_zero  # else it may be of scans that were there before
    measured = measure_input(out, data.training_set.frames, keep=keep, reporter=reporter)
    module = DetectionModule(config, measured, distillation)
    if weights and not resumes:
        module.detector.load_state_dict(module.detector.state_dict() | weights)
    with warnings.catch_warnings(), interrupt.listening():
        # Warnings of torch and Lightning about each other.
        warnings.filterwarnings("ignore", message=".*LeafSpec")
        # EpochSampler starts at the step where the checkpoint stopped, which Lightning cannot know.
        warnings.filterwarnings("ignore", message="You're resuming from a checkpoint that ended before the epoch")
        # Warning on the gradient of 1x1 convolutions, whose two memory layouts are the same.
        warnings.filterwarnings("ignore", message="Grad strides do not match bucket view strides")
        warnings.filterwarnings("ignore", message="Checkpoint directory .* exists and is not empty")
        # Advice on workers and logging that does not fit two cores and small data.
        warnings.filterwarnings("ignore", category=PossibleUserWarning)
        try:
            trainer.fit(module, data, ckpt_path=str(resumed) if resumes else None, weights_only=True)
        finally:  # a run that was stopped has weights to take elsewhere, too
            if trainer.is_global_zero and (checkpoints / LAST).is_file():
                save_weights(checkpoints / LAST, checkpoints / WEIGHTS_FILE)
    return checkpoints / LAST


def syncs_statistics(model: ModelConfig) -> bool:
    """Return whether BatchNorm takes its statistics from all devices; torch does not support that on CPUs.

    In a step of two stages a device may have too few keypoints or proposals to take part, and the others would wait
    for its statistics forever. Each has thousands of rows, which are enough for statistics of its own.
    """
    return torch.cuda.is_available() and isinstance(model, PillarModel)


def _with_resolved_precision(recipe: TrainConfig, out: Path, *, resumes: bool) -> TrainConfig:
    """Resolve `auto` to the precision of the run in `out`, so that it resumes exactly, or to what suits the device."""
    auto = recipe.precision == "auto"
    precision = recorded_precision(out) if auto and resumes else recipe.precision
    return replace(recipe, precision=resolve_precision(precision))


def _trainer(
    config: Config,
    out: Path,
    files: AtomicCheckpointIO,
    own: list[Callback],
    devices: int | str,
    num_nodes: int,
) -> L.Trainer:
    recipe, checkpoints = config.train, out / "checkpoints"
    callbacks: list[Any] = [
        LearningRateMonitor("step"),
        *own,
        BestCheckpoint(checkpoints),
    ]
    if recipe.ema:
        callbacks.append(weight_average(recipe.ema))
    try:
        return L.Trainer(
            default_root_dir=out,
            max_epochs=recipe.epochs,
            precision="bf16-mixed" if recipe.precision == "bf16" else "32-true",
            gradient_clip_val=recipe.gradient_clip or None,
            num_sanity_val_steps=SANITY_STEPS,
            sync_batchnorm=syncs_statistics(config.model),
            use_distributed_sampler=False,
            enable_model_summary=False,
            log_every_n_steps=10,
            plugins=[files],
            logger=TensorBoardLogger(out, name="", version="tensorboard"),
            callbacks=callbacks,
            devices=devices,
            num_nodes=num_nodes,
        )
    except (MisconfigurationException, TypeError, ValueError) as error:
        raise TrainingError(f"devices {devices} x {num_nodes} nodes: {' '.join(str(error).split())}") from None
