"""The whole configuration as one typed tree. Its defaults are the values of ASCA-PointPillars, section 4.1.

What the paper does not give is in docs/READING.md ("What section 4.1 leaves out"). One default is not the paper's:
inserting objects reads a prepared dataset, so it is off until a config asks for it, as that of the paper's recipe does.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Discriminator, Tag

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.settings import read_settings, shipped_configs
from asca_pillars.base.strict import Strict, require_bounds
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.pv_rcnn import PvRcnnModel
from asca_pillars.config.two_stage import RefineModel
from asca_pillars.ops.pillar.spec import PillarSpec

InsertMethod = Literal["none", "gt_aug", "rs_aug"]
Precision = Literal["auto", "fp32", "bf16"]


def _family(settings: Any) -> Any:
    """Return the `kind` of a model's section; a section without one is of pillars, as in older files."""
    kind = settings.get("kind", "pillar") if isinstance(settings, dict) else getattr(settings, "kind", None)
    return None if kind is None else str(kind)


# A family joins as one more `Annotated[OtherModel, Tag("other")]`; `models.build` is where it is built.
ModelConfig: TypeAlias = Annotated[
    Annotated[PillarModel, Tag("pillar")]
    | Annotated[RefineModel, Tag("pillar_refine")]
    | Annotated[PvRcnnModel, Tag("pv_rcnn")],
    Discriminator(_family),
]


@dataclass(frozen=True)
class InsertConfig(Strict):
    """Labelled objects of other frames, put into a training frame before anything else is changed (section 3.5).

    Attributes:
        method: `rs_aug` sets objects on free ground as the paper does; `gt_aug` leaves them where they stood in
            their own frame, as SECOND does; `none`.
        objects: how many are put into a frame where there is room for them.
        proportions: how often each class is wanted in the augmented training set, by name, relative to each other;
            empty: every class as often as any other.
        min_points: objects with fewer points inside their box do not enter the database.
        disable_after_epoch: objects are inserted in so many epochs at the start of a run, and in none after them; if
            not given, in all.
    """

    method: InsertMethod = "none"
    objects: int = 6
    proportions: dict[str, float] = field(default_factory=dict)
    min_points: int = 5
    disable_after_epoch: int | None = None

    def __post_init__(self) -> None:
        require_bounds("augment.insert", self, ("objects",), low=0)
        require_bounds("augment.insert", self, ("min_points",), low=1)
        if self.disable_after_epoch is not None:
            require_bounds("augment.insert", self, ("disable_after_epoch",), low=1)
        for name, share in self.proportions.items():
            if not (math.isfinite(share) and share >= 0):
                raise ConfigError(f"augment.insert.proportions.{name} = {share:g}: must be at least 0")

    def inserts_in(self, epoch: int) -> bool:
        """Return whether objects are inserted in an epoch, counted from 0."""
        return self.method != "none" and (self.disable_after_epoch is None or epoch < self.disable_after_epoch)


@dataclass(frozen=True)
class AugmentConfig(Strict):
    """Random changes of a training frame, each drawn anew for every sample and epoch.

    Attributes:
        insert: objects of other frames that are put into this one.
        flip_probability: of a mirror image about the x axis.
        flip_x_probability: of a mirror image about the y axis. It puts behind what is ahead, for models that look all
            around and are trained on views ahead.
        rotation_rad: the scene turns about z by up to this angle either way.
        scale: (smallest, largest) global scaling.
        shift_z_m: the scene rises or sinks by up to this, as another sensor height would show it.
        object_rotation_rad: each object turns about its own axis by up to this angle either way.
        object_shift_m: standard deviation of each object's shift along x, y and z.
        point_dropout: largest share of a frame's points that is dropped at random.
        object_reflectance_gain: (lowest, highest) factor of each object's reflectance.
        object_jitter_m: standard deviation of the noise of each point of an object along x, y and z.
        object_cut_probability: of each object to lose a sector of azimuth or of elevation, as if partly hidden.
        reflectance_gain: (lowest, highest) factor of the reflectance of all points, as other sensors scale it.
        reflectance_loss_probability: of a sample whose points lose their reflectance, some of them or all.
    """

    insert: InsertConfig = field(default_factory=InsertConfig)
    flip_probability: float = 0.5
    flip_x_probability: float = 0.0
    rotation_rad: float = 0.785398
    scale: tuple[float, float] = (0.95, 1.05)
    shift_z_m: float = 0.0
    object_rotation_rad: float = 0.15708
    object_shift_m: float = 0.25
    point_dropout: float = 0.0
    object_reflectance_gain: tuple[float, float] = (1.0, 1.0)
    object_jitter_m: float = 0.0
    object_cut_probability: float = 0.0
    reflectance_gain: tuple[float, float] = (1.0, 1.0)
    reflectance_loss_probability: float = 0.0

    def __post_init__(self) -> None:
        shares = ("flip_probability", "flip_x_probability", "point_dropout", "object_cut_probability")
        require_bounds("augment", self, (*shares, "reflectance_loss_probability"), low=0, high=1)
        noise = ("rotation_rad", "shift_z_m", "object_rotation_rad", "object_shift_m", "object_jitter_m")
        require_bounds("augment", self, noise, low=0)
        for name in ("scale", "object_reflectance_gain", "reflectance_gain"):
            low, high = getattr(self, name)
            if not 0 < low <= high < math.inf:
                raise ConfigError(f"augment.{name} = {[low, high]}: must be two positive numbers, the smaller first")


@dataclass(frozen=True)
class DataConfig(Strict):
    """Settings for reading a dataset.

    Attributes:
        train_set, val_set: names of lists in ImageSets/.
        camera_view: keep only points that the camera sees, where the dataset has a camera; KITTI labels nothing else.
        min_points: an object with fewer points inside its box is neither a positive nor a negative.
        workers: processes that load and augment.
        prepared: folder for what is computed once per dataset; if not given, prepared/ in the dataset's folder.
    """

    train_set: str = "train"
    val_set: str = "val"
    camera_view: bool = True
    min_points: int = 1
    workers: int = 2
    prepared: str | None = None

    def __post_init__(self) -> None:
        require_bounds("data", self, ("min_points", "workers"), low=0)


@dataclass(frozen=True)
class TrainConfig(Strict):
    """The recipe. Defaults: section 4.1 of the paper, which does not clip gradients.

    Attributes:
        schedule: `step` multiplies the rate by `decay` every `decay_epochs`; `one_cycle` rises to
            `learning_rate` and falls to almost nothing over the run, step by step; `warmup_stable_decay` rises in
            `warmup_steps`, stays, and falls linearly to almost nothing in the last `cooldown` of the run, so that a
            run may be made longer until it falls.
        warmup_steps: optimizer steps in which the rate of `warmup_stable_decay` rises.
        cooldown: share of all steps in which the rate of `warmup_stable_decay` falls.
        gradient_clip: largest norm of the whole gradient; 0 leaves it as it is.
        precision: `fp32`, `bf16`, or `auto`: bf16 where the device has it.
        ema: decay of an exponential moving average of the weights, such as 0.999, that is validated, saved and
            exported in their place; 0 for none.
        teacher: a trained pillar detector whose outputs are learnt beside the labels (arXiv 1503.02531): a checkpoint,
            or a bundle that holds one (folder, or name of one that ships).
        teacher_weight: weight of all terms that the teacher adds.
        checkpoint_steps: also save every so many steps, so that a kill costs minutes, not an epoch.
    """

    epochs: int = 160
    batch_size: int = 6
    learning_rate: float = 2e-4
    weight_decay: float = 0.0
    schedule: Literal["step", "one_cycle", "warmup_stable_decay"] = "step"
    decay: float = 0.8
    decay_epochs: int = 15
    warmup_steps: int = 500
    cooldown: float = 0.2
    gradient_clip: float = 10.0
    precision: Precision = "fp32"
    ema: float = 0.0
    teacher: str | None = None
    teacher_weight: float = 1.0
    checkpoint_steps: int = 500
    seed: int = 0

    def __post_init__(self) -> None:
        require_bounds("train", self, ("epochs", "batch_size", "decay_epochs", "checkpoint_steps"), low=1)
        require_bounds("train", self, ("learning_rate", "weight_decay", "decay", "gradient_clip", "seed"), low=0)
        require_bounds("train", self, ("warmup_steps", "teacher_weight"), low=0)
        require_bounds("train", self, ("cooldown",), low=0, high=1)
        for name in ("learning_rate", "decay"):
            if not getattr(self, name):
                raise ConfigError(f"train.{name} = 0: nothing would be learnt; must be more than 0")
        if not 0 <= self.ema < 1:
            raise ConfigError(f"train.ema = {self.ema:g}: must be at least 0 and less than 1, such as 0.999")


@dataclass(frozen=True)
class Config(Strict):
    """Configuration of a detector and its training."""

    name: str = "asca_pointpillars"
    model: ModelConfig = field(default_factory=PillarModel)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    data: DataConfig = field(default_factory=DataConfig)
    train: TrainConfig = field(default_factory=TrainConfig)

    def __post_init__(self) -> None:
        proportions, names = self.augment.insert.proportions, self.model.spec.class_names
        if unknown := [name for name in proportions if name not in names]:
            raise ConfigError(f"augment.insert.proportions.{unknown[0]}: no such class; available: {', '.join(names)}")
        if proportions and not any(proportions.values()):
            raise ConfigError("augment.insert.proportions: all are 0; set augment.insert.method=none to insert nothing")
        if isinstance(self.model, RefineModel):
            self._require_still_objects()

    def _require_still_objects(self) -> None:
        """Refuse augmentation of single objects: the first stage has run once on each frame, unaugmented."""
        augment = self.augment
        moves = {
            "insert.method": augment.insert.method,
            "object_rotation_rad": augment.object_rotation_rad,
            "object_shift_m": augment.object_shift_m,
            "object_cut_probability": augment.object_cut_probability,
        }
        for name, value in moves.items():
            if value not in ("none", 0):
                still = "none" if name == "insert.method" else 0
                raise ConfigError(
                    f"augment.{name} = {value}: model.kind pillar_refine learns from proposals that are computed once, "
                    f"so only the scene as a whole may move; set augment.{name}={still}"
                )


def pillar_spec(config: Config) -> PillarSpec:
    """Return the spec of a pillar detector, with or without a second stage.

    Raises:
        ConfigError: the model is of another kind.
    """
    spec = config.model.spec
    if not isinstance(spec, PillarSpec):
        raise ConfigError(f"model.kind = {config.model.kind}: has no pillars; give a configuration of kind pillar")
    return spec


def load_config(path: str | Path, overrides: Sequence[str] = ()) -> Config:
    """Read a YAML file that holds what differs from the defaults.

    Args:
        path: the YAML file, or the name of one that ships.
        overrides: `key.subkey=value` texts, value in YAML notation; they win over the file.

    Raises:
        ConfigError: unreadable YAML, an unknown key anywhere (the nearest is named), an impossible value.
    """
    return read_settings(Config, path, overrides, shipped_configs())
