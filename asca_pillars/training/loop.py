"""The training loop, on Lightning: what one step does stands here, launching and devices are Lightning's."""

import logging
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning as L  # noqa: N812  (Lightning's own convention)
import torch
import yaml
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.fabric.utilities.warnings import PossibleUserWarning
from lightning.pytorch.callbacks import LearningRateMonitor, ModelCheckpoint, RichProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from torch.utils.data import DataLoader

from asca_pillars.config import Config, load_config
from asca_pillars.errors import TrainingError
from asca_pillars.evaluation.recall import RecallTally
from asca_pillars.files import atomic_path
from asca_pillars.models.checkpoint import load_checkpoint
from asca_pillars.models.pillar.loss import LossTerms, detection_loss
from asca_pillars.models.pillar.pillar_detector import build_detector, frame_maps
from asca_pillars.schema import to_dict
from asca_pillars.system import describe_environment
from asca_pillars.training.dataset import Batch, KittiDataset
from asca_pillars.training.sampler import EpochSampler

SANITY_STEPS = 2  # validation batches that run before the first training step


def train(
    config: Config,
    data_root: str | Path,
    out: str | Path,
    *,
    devices: str = "auto",
    num_nodes: int = 1,
    init: str | Path | None = None,
) -> Path:
    """Train `config` on a KITTI-layout folder, or go on where an interrupted run in `out` stopped.

    `out` receives config.yaml (resolved), environment.json, TensorBoard logs and checkpoints/{last,best}.ckpt.

    Args:
        config: what to train.
        data_root: folder with training/ and ImageSets/.
        out: folder of this run; one run with the same config in it is resumed exactly.
        devices: number of devices on this machine, or `auto`.
        num_nodes: machines that train together, each started with the same command (torchrun, SLURM).
        init: checkpoint whose weights a new run starts from, instead of random ones.

    Returns:
        The last checkpoint.

    Raises:
        TrainingError: `out` holds a run with another config, `init` is another network, the devices are not there,
            or a loss became infinite or NaN.
        DatasetError: the data cannot be read.
    """
    out = Path(out)
    checkpoints = out / "checkpoints"
    last = checkpoints / "last.ckpt"
    data = DetectionData(config, data_root)
    _claim(out, config)
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    L.seed_everything(config.train.seed, verbose=False)
    module = DetectionModule(config)
    if init is not None and not last.exists():
        _start_from(module, init)
    trainer = _trainer(config, out, devices=int(devices) if devices.isdigit() else devices, num_nodes=num_nodes)
    with warnings.catch_warnings():
        # Of torch and Lightning about each other.
        warnings.filterwarnings("ignore", message=".*LeafSpec")
        # EpochSampler starts at the step where the checkpoint stopped, which Lightning cannot know.
        warnings.filterwarnings("ignore", message="You're resuming from a checkpoint that ended before the epoch")
        # Of a gradient of 1x1 convolutions, whose two layouts in memory are the same.
        warnings.filterwarnings("ignore", message="Grad strides do not match bucket view strides")
        warnings.filterwarnings("ignore", message="Checkpoint directory .* exists and is not empty")
        # Advice on workers and logging that does not fit two cores and small data.
        warnings.filterwarnings("ignore", category=PossibleUserWarning)
        trainer.fit(module, data, ckpt_path=str(last) if last.exists() else None, weights_only=True)
    trainer.save_checkpoint(last)
    return last


class DetectionModule(L.LightningModule):
    """One training step and one validation step of the detector."""

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.save_hyperparameters({"config": to_dict(config)})
        self.config = config
        self.detector = build_detector(config)
        self.recall = RecallTally(config.detector.class_names)

    def training_step(self, batch: Batch, _: int) -> torch.Tensor:
        terms = self._loss(batch)
        self._require_finite(terms, batch)
        self.log_dict(self._named(terms, "train"), batch_size=len(batch.frame_ids))
        self.log("loss", terms.total.detach(), prog_bar=True, logger=False)
        return terms.total

    def validation_step(self, batch: Batch, _: int) -> None:
        maps = self.detector(batch.pillars)
        terms = detection_loss(maps, batch.seen_targets(), self.config.loss)
        self.log_dict(self._named(terms, "val"), sync_dist=True, batch_size=len(batch.frame_ids))
        frames = frame_maps(maps, batch.pillars)
        for (found, cells), boxes, labels in zip(frames, batch.boxes, batch.labels, strict=True):
            self.recall.add(self.config.detector.decode(found, cells), boxes, labels)

    def on_validation_epoch_end(self) -> None:
        rows = self.recall.rows()
        for name, row in rows.items():
            self.log(f"val/recall/{name}", row.recall, sync_dist=True)
            self.log(f"val/false_per_frame/{name}", row.false_per_frame, sync_dist=True)
        if not self.trainer.sanity_checking:
            found = ", ".join(f"{name} {row.recall:.2f} ({row.false_per_frame:.2f})" for name, row in rows.items())
            self.print(f"epoch {self.current_epoch}: recall (false per frame): {found}")
        self.recall = RecallTally(self.config.detector.class_names)

    def configure_optimizers(self) -> Any:
        recipe = self.config.train
        optimizer = torch.optim.Adam(
            self.parameters(),
            lr=recipe.learning_rate,
            weight_decay=recipe.weight_decay,
            decoupled_weight_decay=True,
        )
        if recipe.schedule == "step":
            schedule: Any = torch.optim.lr_scheduler.StepLR(optimizer, recipe.decay_epochs, recipe.decay)
            return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "epoch"}}
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer,
            max_lr=recipe.learning_rate,
            total_steps=recipe.epochs * self.steps_per_epoch(),
            pct_start=0.3,
            div_factor=10,
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def steps_per_epoch(self) -> int:
        """Optimizer steps of one epoch.

        Not Lightning's `estimated_stepping_batches`: that opens the loader before a checkpoint has told the step at
        which the sampler is to go on.
        """
        data: DetectionData = self.trainer.datamodule  # type: ignore[attr-defined]
        return len(data.training_set) // (self.config.train.batch_size * self.trainer.world_size)

    def _loss(self, batch: Batch) -> LossTerms:
        return detection_loss(self.detector(batch.pillars), batch.seen_targets(), self.config.loss)

    def _named(self, terms: LossTerms, stage: str) -> dict[str, torch.Tensor]:
        named = {f"{stage}/{name}": value.detach() for name, value in terms._asdict().items()}
        return {f"{stage}/loss": terms.total.detach()} | named

    def _require_finite(self, terms: LossTerms, batch: Batch) -> None:
        if torch.isfinite(terms.total):
            return
        name = next(name for name, value in terms._asdict().items() if not torch.isfinite(value))
        raise TrainingError(
            f"loss term `{name}` became {getattr(terms, name).item()} at step {self.global_step} on frames "
            f"{', '.join(batch.frame_ids)}; look at these frames, or lower train.learning_rate"
        )


class DetectionData(L.LightningDataModule):
    """Training and validation frames of one KITTI-layout folder."""

    def __init__(self, config: Config, root: str | Path) -> None:
        super().__init__()
        self.config = config
        self.training_set = KittiDataset(root, config, training=True)
        self.validation_set = KittiDataset(root, config, training=False)

    def train_dataloader(self) -> DataLoader[Any]:
        return self._loader(self.training_set, lambda: self.trainer.global_step if self.trainer else 0)

    def val_dataloader(self) -> DataLoader[Any]:
        return self._loader(self.validation_set, None)

    def _loader(self, frames: KittiDataset, step: Callable[[], int] | None) -> DataLoader[Any]:
        trainer = self.trainer
        sampler = EpochSampler(
            len(frames),
            self.config.train.batch_size,
            self.config.train.seed,
            step,
            rank=trainer.global_rank if trainer else 0,
            world_size=trainer.world_size if trainer else 1,
        )
        workers = self.config.data.workers
        return DataLoader(
            frames,
            batch_sampler=sampler,
            num_workers=workers,
            collate_fn=Batch,
            persistent_workers=workers > 0,
            multiprocessing_context="forkserver" if workers else None,
        )


class ProgressBar(RichProgressBar):
    """Lightning's bar without the number of a version that we do not have."""

    def get_metrics(self, *arguments: Any) -> dict[str, Any]:
        return {name: value for name, value in super().get_metrics(*arguments).items() if name != "v_num"}


class AtomicCheckpointIO(TorchCheckpointIO):
    """Checkpoints that a kill cannot leave half written under their name."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None) -> None:
        with atomic_path(path) as temporary:
            torch.save(checkpoint, temporary)


def _trainer(config: Config, out: Path, **devices: Any) -> L.Trainer:
    checkpoints = out / "checkpoints"
    try:
        return L.Trainer(
            default_root_dir=out,
            max_epochs=config.train.epochs,
            precision="bf16-mixed" if config.train.precision == "bf16" else "32-true",
            gradient_clip_val=config.train.gradient_clip or None,
            num_sanity_val_steps=SANITY_STEPS,
            sync_batchnorm=torch.cuda.is_available(),  # there is no such thing on a CPU
            use_distributed_sampler=False,
            enable_model_summary=False,
            log_every_n_steps=10,
            plugins=[AtomicCheckpointIO()],
            logger=TensorBoardLogger(out, name="", version="tensorboard"),
            callbacks=[
                ProgressBar(),
                LearningRateMonitor("step"),
                _checkpoint(checkpoints, "last", every_n_train_steps=config.train.checkpoint_steps),
                _checkpoint(checkpoints, "best", monitor="val/loss"),
            ],
            **devices,
        )
    except (MisconfigurationException, TypeError, ValueError) as error:
        raise TrainingError(
            f"devices {devices['devices']} x {devices['num_nodes']} nodes: {' '.join(str(error).split())}"
        ) from None


def _start_from(module: "DetectionModule", path: str | Path) -> None:
    try:
        module.detector.load_state_dict(load_checkpoint(path).detector.state_dict())
    except RuntimeError as error:
        raise TrainingError(f"{path}: weights of another network ({str(error).splitlines()[1].strip()})") from None


def _checkpoint(folder: Path, name: str, **when: Any) -> ModelCheckpoint:
    return ModelCheckpoint(folder, filename=name, save_top_k=1, enable_version_counter=False, **when)


def _claim(out: Path, config: Config) -> None:
    """Write what this run is into `out`, or make sure that the run found there is the same one."""
    resolved = to_dict(config)
    path = out / "config.yaml"
    if path.exists():
        found = to_dict(load_config(path))  # a run of an older version lacks keys that are younger, not their values
        if difference := _first_difference(found, resolved):
            raise TrainingError(
                f"{path}: the run there was started with {difference}; choose another --out, or delete it"
            )
        for leftover in (out / "checkpoints").glob(".*"):  # of a run that was killed while it saved
            leftover.unlink()
        return
    with atomic_path(out / "environment.json") as temporary:
        temporary.write_text(describe_environment(), encoding="utf-8")
    with atomic_path(path) as temporary:
        temporary.write_text(yaml.safe_dump(resolved, sort_keys=False), encoding="utf-8")


def _first_difference(found: Any, wanted: Any, key: str = "") -> str | None:
    if isinstance(found, dict) and isinstance(wanted, dict):
        for name in wanted | found:
            if difference := _first_difference(found.get(name), wanted.get(name), f"{key}.{name}".lstrip(".")):
                return difference
        return None
    return None if found == wanted else f"{key} = {found}, now {key} = {wanted}"
