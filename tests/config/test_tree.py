"""The configuration: the paper's values, those that ship, and values and keys that are refused."""

import dataclasses
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.schema import parse, to_dict
from asca_pillars.base.settings import shipped_configs
from asca_pillars.config.pillar import LossConfig, PillarModel
from asca_pillars.config.tree import Config, TrainConfig, load_config, pillar_spec
from asca_pillars.detection.anchors import ClassSpec
from asca_pillars.models.build import build_model
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.models.two_stage.first_stage import with_first_stage
from tests.helpers.config_files import refusal, write
from tests.helpers.shipped_configs import CONFIGS


def test_defaults_are_the_paper_s() -> None:
    """DESIGN's reading of section 3 and 4.1: grid, limits, anchors, widths of Table 1, losses, recipe."""
    config = Config()
    assert isinstance(config.model, PillarModel)
    spec = config.model.spec
    assert (spec.grid.x_range_m, spec.grid.y_range_m, spec.grid.z_range_m) == ((0, 69.12), (-39.68, 39.68), (-3, 1))
    assert (spec.grid.v_max_m, spec.grid.v_y_m, spec.grid.zones) == (0.32, 0.16, 3)
    assert (spec.grid.nx, spec.grid.ny) == (72 + 144 + 288, 496)
    assert (spec.limits.max_pillars, spec.limits.max_points) == (12000, 64)
    assert [dataclasses.astuple(item)[:-1] for item in spec.classes] == [
        ("Car", 3.9, 1.6, 1.56, -1.0, 0.6, 0.45),
        ("Pedestrian", 0.8, 0.6, 1.73, -0.6, 0.5, 0.35),
        ("Cyclist", 1.76, 0.6, 1.73, -0.6, 0.5, 0.35),
    ]
    network = config.model.network
    assert (network.pillar_channels, network.block_channels, network.block_convs) == (64, (64, 128, 256), (3, 3, 3))
    assert 3 * network.upsample_channels == 384
    loss = config.model.loss
    assert (loss.box_weight, loss.class_weight, loss.direction_weight) == (2, 1, 0.2)
    assert (loss.focal_alpha, loss.focal_gamma, loss.smooth_l1_beta) == (0.25, 2, 1 / 9)
    train = config.train
    assert (train.epochs, train.batch_size, train.learning_rate) == (160, 6, 2e-4)
    assert (train.schedule, train.decay, train.decay_epochs, train.weight_decay) == ("step", 0.8, 15, 0)
    augment = config.augment
    assert augment.flip_probability == 0.5 and augment.rotation_rad == pytest.approx(math.pi / 4, abs=1e-6)
    assert augment.scale == (0.95, 1.05) and augment.shift_z_m == augment.point_dropout == 0
    assert augment.object_rotation_rad > 0 and augment.object_shift_m > 0


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_configs_that_ship_load_and_build(path: Path) -> None:
    config = load_config(path)
    assert load_config(path.stem) == config, "found by its name too"
    assert parse(Config, yaml.safe_load(yaml.safe_dump(to_dict(config))), "model.yaml") == config, "and comes back"
    model = with_first_stage(config.model) if config.model.kind == "pillar_refine" else config.model
    with torch.device("meta"):  # layers and shapes, without the time that random weights take
        detector = build_model(model)
    if not isinstance(config.model, PillarModel):
        return
    assert isinstance(detector, PillarDetector) and detector.grid == config.model.spec.grid
    scores = detector.head.scores.weight
    spec = config.model.spec
    per_cell = 2 * len(spec.classes) * spec.scores_per_anchor
    assert scores.shape == (per_cell, 3 * config.model.network.upsample_channels, 1, 1)


def test_the_baseline_is_pointpillars_and_every_configuration_ships() -> None:
    """DESIGN 4.1: K = 1 and V_max = 0.16 m are PointPillars, 432 x 496 pillars without attention."""
    assert {path.stem for path in CONFIGS} == set(shipped_configs()) >= {"asca_pointpillars_kitti"}
    model = load_config("pointpillars_kitti").model
    assert isinstance(model, PillarModel)
    assert (model.spec.grid.nx, model.spec.grid.ny, model.network.cpa) == (432, 496, "none")


def sections(settings: object, path: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], object]]:
    """The dataclass `settings` and all that it holds, also in tuples, each with the keys that lead to it."""
    yield path, settings
    for item in dataclasses.fields(settings):  # type: ignore[arg-type]
        value = getattr(settings, item.name)
        if dataclasses.is_dataclass(value):
            yield from sections(value, (*path, item.name))
        elif isinstance(value, tuple):
            for index, part in enumerate(value):
                if dataclasses.is_dataclass(part):
                    yield from sections(part, (*path, item.name, index))


SECTIONS = dict(sections(Config()))
assert len(SECTIONS) == 15


@pytest.mark.parametrize("path", SECTIONS, ids=lambda path: ".".join(map(str, path)) or "top")
def test_unknown_keys_and_values_of_the_wrong_type_at_every_level(path: tuple[str | int, ...]) -> None:
    """Each key of each level with a letter too much, which names the nearest; one like none of them; nonsense."""

    def refused(key: str, value: object) -> str:
        data = to_dict(Config())
        level: Any = data
        for part in path:
            level = level[part]
        level[key] = value
        with pytest.raises(ConfigError) as caught:
            parse(Config, data, "model.yaml")
        return str(caught.value)

    for item in dataclasses.fields(SECTIONS[path]):  # type: ignore[arg-type]
        for wrong, advice in ((f"{item.name}x", f"did you mean `{item.name}`?"), ("Q", "known keys: ")):
            key = ".".join(map(str, (*path, wrong)))
            assert refused(wrong, None).startswith(f"model.yaml: unknown key `{key}`; {advice}")
        key = re.escape(".".join(map(str, (*path, item.name))))
        assert re.match(rf"model\.yaml: .*`{key}[.`0-9a-z_]* ?", refused(item.name, [{"nonsense": None}]))


def test_a_file_holds_what_differs(tmp_path: Path) -> None:
    config = load_config(
        write(tmp_path, "train: {epochs: 3, learning_rate: 1e-3}\nmodel:\n  spec: {grid: {zones: 1}}\n")
    )
    assert config.train == TrainConfig(epochs=3, learning_rate=1e-3) and pillar_spec(config).grid.zones == 1
    assert isinstance(config.model, PillarModel)
    assert config.model.loss == LossConfig() and config.model.spec.classes == Config().model.spec.classes
    assert load_config(write(tmp_path, "# only a comment\n")) == Config()


def test_a_loss_of_an_older_version_and_one_without_a_finite_gradient(tmp_path: Path) -> None:
    older = to_dict(LossConfig())
    del older["score_target"], older["assigner"]
    config = load_config(write(tmp_path, yaml.safe_dump({"model": {"loss": older}})))
    assert isinstance(config.model, PillarModel) and config.model.loss == LossConfig()
    assert (config.model.loss.score_target, config.model.loss.assigner) == ("one", "overlap")
    text = "model: {{loss: {{score_target: iou, focal_gamma: {}}}}}"
    for gamma in (0, 1, 2):
        load_config(write(tmp_path, text.format(gamma)))
    refused = refusal(write(tmp_path, text.format(0.5)))
    assert "model.loss.focal_gamma = 0.5: with model.loss.score_target iou" in refused


def test_classes_of_one_s_own(tmp_path: Path) -> None:
    text = """
model:
  spec:
    classes:
      - {name: Truck, length_m: 9, width_m: 2.5, height_m: 3.2, z_m: -0.2, positive_iou: 0.6, negative_iou: 0.45}
"""
    config = load_config(write(tmp_path, text))
    assert config.model.spec.classes == (ClassSpec("Truck", 9, 2.5, 3.2, -0.2, 0.6, 0.45),)
    assert "`model.spec.classes.0.lengthm`; did you mean `length_m`" in refusal(
        write(tmp_path, text.replace("length_m", "lengthm"))
    )


AT_LEAST_1 = (
    *("model.network.pillar_channels", "augment.insert.min_points", "augment.insert.disable_after_epoch"),
    *("train.epochs", "train.batch_size", "train.decay_epochs", "train.checkpoint_steps"),
)
AT_LEAST_0 = (
    *("model.loss.box_weight", "model.loss.smooth_l1_beta", "augment.insert.objects", "augment.insert.proportions.Car"),
    *("augment.object_shift_m", "augment.object_jitter_m", "data.min_points", "data.workers"),
    *("train.learning_rate", "train.weight_decay", "train.seed"),
)
SHARES = (
    *("model.loss.focal_alpha", "augment.flip_probability", "augment.flip_x_probability", "augment.point_dropout"),
    *("augment.object_cut_probability", "augment.reflectance_loss_probability"),
)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        *((key, "0", "must be at least 1") for key in AT_LEAST_1),
        *((key, "-1", "must be at least 0") for key in AT_LEAST_0),
        *((key, value, "must lie between 0 and 1") for key in SHARES for value in ("1.5", "-0.1")),
        *((key, "0", "must be more than 0") for key in ("train.learning_rate", "train.decay")),
        *((key, ".nan", "should be a finite number") for key in ("train.ema", "train.learning_rate")),
        ("model.network.block_channels", "[64, 0, 256]", "must be at least 1"),
        ("model.network.block_convs", "[3, -1, 3]", "must be at least 0"),
        ("model.loss.score_target", "giou", "input should be 'one' or 'iou'"),
        ("model.loss.assigner", "max_iou", "input should be 'overlap' or 'atss'"),
        ("augment.rotation_rad", ".inf", "should be a finite number"),
        ("augment.object_reflectance_gain", "[2, 0.5]", "must be two positive numbers, the smaller first"),
        ("augment.reflectance_gain", "[0, 2]", "must be two positive numbers, the smaller first"),
        ("augment.scale", "[1.05, 0.95]", "must be two positive numbers, the smaller first"),
        ("augment.scale", "[0, 1]", "must be two positive numbers, the smaller first"),
        ("augment.scale", "[.nan, 1]", "should be a finite number"),
        ("train.ema", "1", "must be at least 0 and less than 1"),
        ("train.batch_size", "true", "should be a number"),
        ("train.epochs", "1" + 400 * "0", "must be at most 9.0072e"),
    ],
)
def test_impossible_numbers(tmp_path: Path, key: str, value: str, message: str) -> None:
    *parents, name = key.split(".")
    path = write(tmp_path, "".join(f"{parent}: {{" for parent in parents) + f"{name}: {value}" + "}" * len(parents))
    assert re.fullmatch(rf"{re.escape(str(path))}: `?{re.escape(key)}.* = .+: .*{message}.*", refusal(path))


CAR = "length_m: 9, width_m: 2.5, height_m: 3.2, z_m: -0.2, positive_iou: 0.6, negative_iou: 0.45"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "augment: {insert: {proportions: {Lorry: 1}}}",
            "augment.insert.proportions.Lorry: no such class; available: Car, Pedestrian, Cyclist",
        ),
        (
            "augment: {insert: {proportions: {Car: 0}}}",
            "augment.insert.proportions: all are 0; set augment.insert.method=none to insert nothing",
        ),
        (
            "model: {network: {cpa: paper}, spec: {limits: {max_pillars: 5}}}",
            "max_pillars = 5: must be at least 6 with cpa paper",
        ),
        (
            "model: {kind: pv_rcnn, spec: {post: {vote_iou: 0.6}}}",
            "model.spec.post.vote_iou = 0.6: the boxes of a second stage do not vote; leave it out",
        ),
        (
            f"model: {{spec: {{classes: [{{name: Car, {CAR}}}, {{name: car, {CAR}}}]}}}}",
            "classes Car, car must have different names",
        ),
    ],
)
def test_what_does_not_go_together(tmp_path: Path, text: str, message: str) -> None:
    assert message in refusal(write(tmp_path, text))
