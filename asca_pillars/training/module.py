"""Steps of training and of validation, for every family of detectors."""

import functools
import math
from collections.abc import Mapping
from typing import Any

import lightning as L  # noqa: N812  (Lightning's own convention)
import numpy as np
import torch
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR, OneCycleLR, StepLR

from asca_pillars.base.errors import AscaError, TrainingError
from asca_pillars.base.schema import to_dict
from asca_pillars.config.tree import Config, Precision, TrainConfig
from asca_pillars.evaluation.recall import RecallTally
from asca_pillars.models.build import build_model
from asca_pillars.models.pillar.trained import Distillation
from asca_pillars.scans.input_check import ExpectedInput
from asca_pillars.training.dataset import Batch


class DetectionModule(L.LightningModule):
    """One training step and one validation step of a detector.

    Args:
        config: of the run.
        expected_input: of its training scans; it goes into every checkpoint.
        distillation: what a teacher adds to the loss; None for no teacher.
    """

    def __init__(
        self,
        config: Config,
        expected_input: ExpectedInput | None = None,
        distillation: Distillation | None = None,
    ) -> None:
        super().__init__()
        measured = None if expected_input is None else to_dict(expected_input)
        self.save_hyperparameters({"config": to_dict(config), "expected_input": measured})
        self.config = config
        self.detector = build_model(config.model)
        self.recall = RecallTally(config.model.spec.class_names)
        self._distill = distillation

    def training_step(self, batch: Batch | AscaError, _: int) -> Tensor:
        """Return the loss of one batch, a scalar.

        Raises:
            AscaError: a frame of the batch could not be read, or a term of its loss is not finite.
        """
        batch = _read(batch)
        # Dropout depends on the step, so that a resumed run drops the same as an uninterrupted one.
        draws = np.random.SeedSequence((self.config.train.seed, self.global_step, self.global_rank))
        torch.manual_seed(int(draws.generate_state(1, np.uint64)[0]))
        outputs = self.detector.predict(batch.inputs)
        terms = self.detector.loss(outputs, batch.inputs)
        if self._distill is not None:
            terms = {**terms, **self._distill(outputs, batch.inputs)}
        total = _total(terms)
        self._require_finite(terms, batch)
        self.log_dict(_named(terms, "train"), batch_size=len(batch.frame_ids))
        self.log("loss", total.detach(), prog_bar=True, logger=False)
        return total

    def validation_step(self, batch: Batch | AscaError, _: int) -> None:
        """Log loss, recall and false detections of one batch."""
        batch = _read(batch)
        outputs = self.detector.predict(batch.inputs)
        terms = self.detector.loss(outputs, batch.inputs)
        self.log_dict(_named(terms, "val"), sync_dist=True, batch_size=len(batch.frame_ids))
        per_frame = self.detector.detect(outputs, self.config.model.spec)
        for detections, boxes, labels in zip(per_frame, batch.boxes, batch.labels, strict=True):
            self.recall.add(detections, boxes, labels)

    def on_validation_epoch_end(self) -> None:
        """Log recall over the frames of all ranks: counts are summed, because a mean of shares is not the share."""
        counts = self.trainer.strategy.reduce(torch.from_numpy(self.recall.counts).to(self.device), reduce_op="sum")
        self.recall = RecallTally(self.config.model.spec.class_names, counts.cpu().numpy())
        rows = self.recall.rows()
        for name, row in rows.items():
            self.log(f"val/recall/{name}", row.recall)
            self.log(f"val/false_per_frame/{name}", row.false_per_frame)
        if not self.trainer.sanity_checking:
            recalls = ", ".join(f"{name} {row.recall:.2f} ({row.false_per_frame:.2f})" for name, row in rows.items())
            self.print(f"epoch {self.current_epoch + 1}: recall (false per frame): {recalls}")
        self.recall = RecallTally(self.config.model.spec.class_names)

    def configure_optimizers(self) -> Any:
        """Return Adam, and the schedule of the configuration; both count optimizer steps."""
        recipe = self.config.train
        optimizer = torch.optim.Adam(
            self.parameters(),
            lr=recipe.learning_rate,
            weight_decay=recipe.weight_decay,
            decoupled_weight_decay=True,
        )
        schedule = make_schedule(optimizer, recipe, self.steps_per_epoch())
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def steps_per_epoch(self) -> int:
        """Return the optimizer steps of one epoch.

        Not Lightning's `estimated_stepping_batches`: that opens the loader before a checkpoint has told the step at
        which the sampler is to resume.
        """
        frames = len(self.trainer.datamodule.training_set)  # type: ignore[attr-defined]
        return steps_per_epoch(self.config.train, frames, self.trainer.world_size)

    def _require_finite(self, terms: Mapping[str, Tensor], batch: Batch) -> None:
        for name, value in terms.items():
            if not torch.isfinite(value):
                raise TrainingError(
                    f"loss term `{name}` became {value.item()} at step {self.global_step} on frames "
                    f"{', '.join(batch.frame_ids)}; look at these frames, or lower train.learning_rate"
                )


def _read(batch: Batch | AscaError) -> Batch:
    if isinstance(batch, AscaError):
        raise batch
    return batch


def _total(terms: Mapping[str, Tensor]) -> Tensor:
    return functools.reduce(torch.add, terms.values())


def _named(terms: Mapping[str, Tensor], stage: str) -> dict[str, Tensor]:
    named = {f"{stage}/{name}": value.detach() for name, value in terms.items()}
    return {f"{stage}/loss": _total(terms).detach()} | named


def make_schedule(optimizer: Optimizer, recipe: TrainConfig, epoch_steps: int) -> Any:
    """Return the schedule that `recipe` names, stepped once per optimizer step; an epoch has `epoch_steps`."""
    if recipe.schedule == "step":
        # Counted in steps, so that a checkpoint taken just before the end of an epoch holds all of its state.
        return StepLR(optimizer, recipe.decay_epochs * epoch_steps, recipe.decay)
    total_steps = recipe.epochs * epoch_steps
    if recipe.schedule == "warmup_stable_decay":
        return LambdaLR(optimizer, functools.partial(warmup_stable_decay, recipe, total_steps))
    return OneCycleLR(
        optimizer,
        max_lr=recipe.learning_rate,
        total_steps=total_steps,
        pct_start=0.3,  # fast.ai's one-cycle value and torch's default, stated because it is part of the recipe
        div_factor=10,  # as OpenPCDet starts it
    )


def warmup_stable_decay(recipe: TrainConfig, total_steps: int, step: int) -> float:
    """Return the factor of the learning rate at `step` of `total_steps`: a linear rise, then 1, then a linear fall.

    It is more than 0 at every step from 0 to `total_steps` - 1 (Hu et al., MiniCPM, arXiv 2404.06395).
    """
    rise = (step + 1) / (recipe.warmup_steps + 1)
    fall = (total_steps - step) / (total_steps - cooldown_start(recipe, total_steps) + 1)
    return max(0.0, min(1.0, rise, fall))


def cooldown_start(recipe: TrainConfig, total_steps: int) -> int:
    """Return the first step of `warmup_stable_decay` whose rate depends on the length of the run."""
    return math.ceil((1 - recipe.cooldown) * total_steps)


def steps_per_epoch(recipe: TrainConfig, frames: int, processes: int) -> int:
    """Return the optimizer steps of one epoch: whole batches of every process."""
    return frames // (recipe.batch_size * processes)


def has_bfloat16(device: str | None = None) -> bool:
    """Return whether a device multiplies in bfloat16 itself. None is Lightning's choice: a GPU if there is one.

    Others emulate it: twenty times slower than float32 on a CPU with AVX2 alone.
    """
    if device != "cpu" and torch.cuda.is_available():
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())  # oneDNN's own answer, which has no public name


def resolve_precision(precision: Precision, device: str | None = None) -> Precision:
    """Resolve `auto` to what suits a device; other values stay, see `has_bfloat16`."""
    if precision != "auto":
        return precision
    return "bf16" if has_bfloat16(device) else "fp32"
