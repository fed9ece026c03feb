"""The whole configuration as one typed tree. Its defaults are the paper's values (ASCA-PointPillars, section 4.1).

One is not: inserting objects reads a prepared dataset, so it is off until a config asks for it, as the paper's does.
"""

import math
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, TypeVar

import yaml
from pydantic import Discriminator, Tag

from asca_pillars.errors import ConfigError
from asca_pillars.pillars.pillar_spec import PillarSpec
from asca_pillars.pv_rcnn_config import PvRcnnModel
from asca_pillars.refine_config import RefineModel
from asca_pillars.schema import Strict, parse
from asca_pillars.tables.neck_tables import MaskRule
from asca_pillars.yaml_text import MAX_CHARACTERS, parse_yaml

T = TypeVar("T")

_LARGEST = 2.0**53  # of settings: up to here a float counts every whole number

CpaReading = Literal["none", "paper", "channel", "point"]
InsertMethod = Literal["none", "gt_aug", "rs_aug"]


@dataclass(frozen=True)
class NetworkConfig(Strict):
    """Widths and depths of the network.

    Attributes:
        cpa: reading of the correlative point attention, see docs/READING.md.
        pillar_channels: C, features of one pillar.
        block_channels: output channels of Block1..3 (Table 1).
        block_convs: stride-1 convolutions that follow each block's strided one (Table 1: 3).
        upsample_channels: output channels of each DeBlock (Table 1: 128).
        neck: `dense` computes everywhere, `sparse` at active cells alone; the weights fit both.
        active_cells: which cells are active in a sparse neck, see `tables.neck_tables`.
    """

    cpa: CpaReading = "channel"
    pillar_channels: int = 64
    block_channels: tuple[int, int, int] = (64, 128, 256)
    block_convs: tuple[int, int, int] = (3, 3, 3)
    upsample_channels: int = 128
    neck: Literal["dense", "sparse"] = "dense"
    active_cells: MaskRule = "fine"

    def __post_init__(self) -> None:
        _require("model.network", self, ("pillar_channels", "block_channels", "upsample_channels"), low=1)
        _require("model.network", self, ("block_convs",), low=0)
        if self.neck == "sparse" and self.active_cells == "fine" and not self.block_convs[0]:
            raise ConfigError(
                "model.network.active_cells = fine grows in the first block's stride-1 convolutions, of which "
                "model.network.block_convs has none; give it one, or set model.network.active_cells=sub"
            )


@dataclass(frozen=True)
class LossConfig(Strict):
    """Eq. (13)-(15) with the residuals of PointPillars; `smooth_l1_beta` is SECOND's 1/9."""

    box_weight: float = 2.0
    class_weight: float = 1.0
    direction_weight: float = 0.2
    focal_alpha: float = 0.25
    focal_gamma: float = 2.0
    smooth_l1_beta: float = 1 / 9

    def __post_init__(self) -> None:
        weights = ("box_weight", "class_weight", "direction_weight")
        _require("model.loss", self, (*weights, "focal_gamma", "smooth_l1_beta"), low=0)
        _require("model.loss", self, ("focal_alpha",), low=0, high=1)


@dataclass(frozen=True)
class PillarModel(Strict):
    """ASCA-PointPillars and PointPillars: one stage on pillars.

    Attributes:
        kind: tells the families of detectors apart.
        spec: grid, limits, classes and post-processing, which training and the vehicle share.
        network: widths and depths.
        loss: weights of the loss.
    """

    kind: Literal["pillar"] = "pillar"
    spec: PillarSpec = field(default_factory=PillarSpec)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    loss: LossConfig = field(default_factory=LossConfig)


def _family(settings: Any) -> Any:
    """The `kind` of a model's section; one that says nothing is of pillars, as all were before there were others."""
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
    """

    method: InsertMethod = "none"
    objects: int = 6
    proportions: dict[str, float] = field(default_factory=dict)
    min_points: int = 5

    def __post_init__(self) -> None:
        _require("augment.insert", self, ("objects",), low=0)
        _require("augment.insert", self, ("min_points",), low=1)
        for name, share in self.proportions.items():
            if not (math.isfinite(share) and share >= 0):
                raise ConfigError(f"augment.insert.proportions.{name} = {share:g}: must be at least 0")


@dataclass(frozen=True)
class AugmentConfig(Strict):
    """Random changes of a training frame, each drawn anew for every sample and epoch.

    Attributes:
        insert: objects of other frames that are put into this one.
        flip_probability: of a mirror image about the x axis.
        rotation_rad: the scene turns about z by up to this angle either way.
        scale: (smallest, largest) global scaling.
        shift_z_m: the scene rises or sinks by up to this, as another sensor height would show it.
        object_rotation_rad: each object turns about its own axis by up to this angle either way.
        object_shift_m: standard deviation of each object's shift along x, y and z.
        point_dropout: largest share of a frame's points that is dropped at random.
        object_reflectance_gain: (lowest, highest) factor of each object's reflectance.
        object_jitter_m: standard deviation of the noise of each point of an object along x, y and z.
        object_cut_probability: of each object to lose a sector of azimuth or of elevation, as if partly hidden.
        reflectance_loss_probability: of a sample whose points lose their reflectance, some of them or all.
    """

    insert: InsertConfig = field(default_factory=InsertConfig)
    flip_probability: float = 0.5
    rotation_rad: float = 0.785398
    scale: tuple[float, float] = (0.95, 1.05)
    shift_z_m: float = 0.0
    object_rotation_rad: float = 0.15708
    object_shift_m: float = 0.25
    point_dropout: float = 0.0
    object_reflectance_gain: tuple[float, float] = (1.0, 1.0)
    object_jitter_m: float = 0.0
    object_cut_probability: float = 0.0
    reflectance_loss_probability: float = 0.0

    def __post_init__(self) -> None:
        shares = ("flip_probability", "point_dropout", "object_cut_probability", "reflectance_loss_probability")
        _require("augment", self, shares, low=0, high=1)
        noise = ("rotation_rad", "shift_z_m", "object_rotation_rad", "object_shift_m", "object_jitter_m")
        _require("augment", self, noise, low=0)
        for name in ("scale", "object_reflectance_gain"):
            low, high = getattr(self, name)
            if not 0 < low <= high < math.inf:
                raise ConfigError(f"augment.{name} = {[low, high]}: must be two positive numbers, the smaller first")


@dataclass(frozen=True)
class DataConfig(Strict):
    """What is read from a dataset.

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
        _require("data", self, ("min_points", "workers"), low=0)


@dataclass(frozen=True)
class TrainConfig(Strict):
    """The recipe. Defaults: section 4.1 of the paper.

    Attributes:
        schedule: `step` multiplies the rate by `decay` every `decay_epochs`; `one_cycle` rises to
            `learning_rate` and falls to almost nothing over the run, step by step.
        gradient_clip: largest norm of the whole gradient; 0 leaves it as it is.
        precision: `fp32` or `bf16`.
        ema: decay of an exponential moving average of the weights, such as 0.999, that is validated, saved and
            exported in their place; 0 for none.
        checkpoint_steps: also save every so many steps, so that a kill costs minutes, not an epoch.
    """

    epochs: int = 160
    batch_size: int = 6
    learning_rate: float = 2e-4
    weight_decay: float = 0.0
    schedule: Literal["step", "one_cycle"] = "step"
    decay: float = 0.8
    decay_epochs: int = 15
    gradient_clip: float = 10.0
    precision: Literal["fp32", "bf16"] = "fp32"
    ema: float = 0.0
    checkpoint_steps: int = 500
    seed: int = 0

    def __post_init__(self) -> None:
        _require("train", self, ("epochs", "batch_size", "decay_epochs", "checkpoint_steps"), low=1)
        _require("train", self, ("learning_rate", "weight_decay", "decay", "gradient_clip", "seed"), low=0)
        if not 0 <= self.ema < 1:
            raise ConfigError(f"train.ema = {self.ema:g}: must be at least 0 and less than 1, such as 0.999")


@dataclass(frozen=True)
class Config(Strict):
    """One model a person would train: what it sees, what it is, how it learns."""

    name: str = "asca_pointpillars"
    model: ModelConfig = field(default_factory=PillarModel)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    data: DataConfig = field(default_factory=DataConfig)
    train: TrainConfig = field(default_factory=TrainConfig)

    def __post_init__(self) -> None:
        wanted, names = self.augment.insert.proportions, self.model.spec.class_names
        if unknown := [name for name in wanted if name not in names]:
            raise ConfigError(f"augment.insert.proportions.{unknown[0]}: no such class; there are {', '.join(names)}")
        if wanted and not any(wanted.values()):
            raise ConfigError("augment.insert.proportions: all are 0; set augment.insert.method=none to insert nothing")
        if isinstance(self.model, RefineModel):
            self._require_still_objects()

    def _require_still_objects(self) -> None:
        """The first stage has seen each frame once, as it is: nothing may move in it but the whole scene."""
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
    """The numbers of a pillar detector, with or without a second stage.

    Raises:
        ConfigError: the model is of another kind.
    """
    spec = config.model.spec
    if not isinstance(spec, PillarSpec):
        raise ConfigError(f"model.kind = {config.model.kind}: has no pillars; give a configuration of kind pillar")
    return spec


def shipped_configs(kind: str = "") -> dict[str, Path]:
    """The configurations that come along, by name: those of the installed package, or of the checkout.

    Args:
        kind: folder below configs/ for those of something else than a model.
    """
    package = Path(__file__).parent
    folders = (package / "configs" / kind, package.parent / "configs" / kind)
    return {path.stem: path for folder in folders for path in sorted(folder.glob("*.yaml"))}


def load_config(path: str | Path, overrides: Sequence[str] = ()) -> Config:
    """Read a YAML file that holds what differs from the defaults.

    Args:
        path: the YAML file, or the name of one that ships.
        overrides: `key.subkey=value` texts, value in YAML notation; they win over the file.

    Raises:
        ConfigError: unreadable YAML, an unknown key anywhere (the nearest is named), an impossible value.
    """
    return read_settings(Config, path, overrides, shipped_configs())


def read_settings(type_: type[T], path: str | Path, overrides: Sequence[str], shipped: Mapping[str, Path]) -> T:
    """Settings of any dataclass, as `load_config` reads those of a model; `shipped` are the names that stand for files.

    Raises:
        ConfigError: as `load_config`.
    """
    path = shipped.get(str(path), Path(path))
    try:
        if path.stat().st_size > 4 * MAX_CHARACTERS:  # a character has up to four bytes
            raise ConfigError(f"{path}: {path.stat().st_size} bytes are too many for settings; give another file")
        data = parse_yaml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); these ship: {', '.join(shipped)}") from None
    except (yaml.YAMLError, ValueError) as error:  # ValueError: not UTF-8, or a date like 2026-99-99
        raise ConfigError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from None
    if data is None:
        data = {}
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: expected `key: value` lines, found a {type(data).__name__}")
    settings = parse(type_, data, str(path))
    if not overrides:
        return settings
    for override in overrides:
        _apply(data, override)
    return parse(type_, data, f"{path} with {' '.join(overrides)}")


def _require(section: str, settings: Strict, names: Sequence[str], *, low: float, high: float = math.inf) -> None:
    """Refuse numbers, alone or in a tuple, below `low`, above `high` or not finite."""
    for name in names:
        value = getattr(settings, name)
        for number in value if isinstance(value, tuple) else (value,):
            # Compared, never converted: a whole number may be larger than any float.
            if abs(number) > _LARGEST and number != math.inf:
                raise ConfigError(f"{section}.{name} = {reprlib.repr(number)}: must be at most {_LARGEST:g}")
            if not low <= number <= high or number == math.inf:
                bounds = f"be at least {low:g}" if high == math.inf else f"lie between {low:g} and {high:g}"
                raise ConfigError(f"{section}.{name} = {number:g}: must {bounds}")


def _apply(data: dict[str, Any], override: str) -> None:
    """Set `key.subkey=value` in the nested dictionary `data`."""
    key, separator, text = override.partition("=")
    if not separator or not key:
        raise ConfigError(f"`{override}`: an override is written key.subkey=value, such as train.epochs=20")
    *parents, leaf = key.strip().split(".")
    for parent in parents:
        data = data.setdefault(parent, {})
        if not isinstance(data, dict):
            raise ConfigError(f"`{override}`: `{parent}` is a value, it has no keys")
    try:
        data[leaf] = parse_yaml(text)
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(f"`{override}`: the value is not valid YAML: {' '.join(str(error).split())}") from None
