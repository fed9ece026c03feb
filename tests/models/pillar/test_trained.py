"""Training by a teacher: what it adds to the loss, which teachers are refused, and that no checkpoint holds one."""

import dataclasses
from pathlib import Path

import pytest
import torch
from torch import Tensor

from asca_pillars.base.errors import BundleError, ConfigError
from asca_pillars.config.pillar import LossConfig, PillarModel
from asca_pillars.config.tree import Config, load_config
from asca_pillars.config.two_stage import RefineModel
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.models.checkpoint_file import read_checkpoint
from asca_pillars.models.pillar.loss import FOREGROUND_SCORE, box_loss, distillation_loss
from asca_pillars.models.pillar.trained import Distillation
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.training.loop import train
from tests.export.tiny import tiny_checkpoint
from tests.helpers.saved_checkpoint import save_checkpoint
from tests.helpers.scenes import SPEC, write_dataset
from tests.helpers.tiny_run import CONFIG, NETWORK, with_train
from tests.models.two_stage.tiny_refine import STILL_OBJECTS

LOSS = LossConfig(box_weight=2.0, class_weight=3.0, direction_weight=0.5, focal_gamma=2.0)


def one_anchor(score: float, box: list[float], direction: list[float]) -> HeadMaps[Tensor]:
    """Rows of one cell with one anchor; `score` is a logit."""
    return HeadMaps(torch.tensor([[score]]), torch.tensor([box]), torch.tensor([direction]))


def with_network(**changes: object) -> Config:
    network = dataclasses.replace(NETWORK, **changes)  # type: ignore[arg-type]
    return dataclasses.replace(CONFIG, model=PillarModel(spec=SPEC, network=network))


def with_spec(spec: PillarSpec) -> Config:
    return dataclasses.replace(CONFIG, model=PillarModel(spec=spec, network=NETWORK))


def narrower(spec: PillarSpec) -> PillarSpec:
    return dataclasses.replace(spec, grid=dataclasses.replace(spec.grid, y_range_m=(-5.12, 5.12)))


@pytest.fixture
def teacher(tmp_path: Path) -> str:
    save_checkpoint(tmp_path / "teacher.ckpt", tiny_checkpoint("channel"))
    return str(tmp_path / "teacher.ckpt")


def test_a_detector_that_is_its_teacher_has_the_least_loss() -> None:
    generator = torch.Generator().manual_seed(0)
    maps = HeadMaps(*(torch.randn((5, 6 * values), generator=generator) for values in (1, 7, 2)))
    least = distillation_loss(maps, maps, LOSS)
    assert least.teacher_box == least.teacher_classification == 0
    for part in range(3):
        moved = maps._replace(**{maps._fields[part]: maps[part] + 0.3 * torch.sign(maps[part])})
        assert distillation_loss(moved, maps, LOSS)[(1, 0, 2)[part]] > least[(1, 0, 2)[part]]


def test_terms_of_one_anchor_by_hand() -> None:
    """A teacher's score of 0.8 where the detector says 0.5, a box 0.5 off along x, and heads that differ by a log 3."""
    found = one_anchor(0.0, [0.5, 0, 0, 0, 0, 0, 0.1], [0.0, 0.0])
    wanted = one_anchor(float(torch.logit(torch.tensor(0.8))), [0.0, 0, 0, 0, 0, 0, 0.1], [0.0, 0.0])
    terms = distillation_loss(found, wanted, LOSS)
    entropy = float(torch.log(torch.tensor(2.0)))
    assert terms.teacher_classification.item() == pytest.approx(3.0 * 0.3**2 * entropy, rel=1e-5)  # total of scores: 1
    assert terms.teacher_box.item() == pytest.approx(2.0 * 0.8 * (0.5 - 0.5 * LOSS.smooth_l1_beta), rel=1e-5)
    assert terms.teacher_direction.item() == pytest.approx(0.5 * 0.8 * entropy, rel=1e-5)


def test_background_of_the_teacher_has_no_box_to_learn() -> None:
    below = float(torch.logit(torch.tensor(FOREGROUND_SCORE - 0.01)))
    found = one_anchor(0.0, [3.0] * 7, [2.0, -2.0])
    terms = distillation_loss(found, one_anchor(below, [0.0] * 7, [0.0, 0.0]), LOSS)
    assert terms.teacher_box == terms.teacher_direction == 0
    assert terms.teacher_classification > 0


def test_weights_of_boxes_are_those_of_their_residuals() -> None:
    generator = torch.Generator().manual_seed(1)
    found, wanted = torch.randn((4, 7), generator=generator), torch.randn((4, 7), generator=generator)
    weights = torch.tensor([[1.0], [0.0], [2.0], [0.5]])
    each = [box_loss(found[i : i + 1], wanted[i : i + 1], 1 / 9) for i in range(4)]
    expected = each[0] + 2 * each[2] + 0.5 * each[3]
    assert box_loss(found, wanted, 1 / 9, weights).item() == pytest.approx(expected.item(), rel=1e-6)


def test_a_teacher_is_learnt_from_and_in_no_checkpoint(tmp_path: Path, teacher: str) -> None:
    data = write_dataset(tmp_path / "data", 3)
    runs = {"alone": with_train(epochs=1), "taught": with_train(epochs=1, teacher=teacher)}
    alone, taught = (read_checkpoint(train(config, data, tmp_path / name)).weights for name, config in runs.items())
    assert alone.keys() == taught.keys()
    assert not torch.equal(alone["head.scores.weight"], taught["head.scores.weight"])
    nothing = with_train(epochs=1, teacher=teacher, teacher_weight=0.0)
    untaught = read_checkpoint(train(nothing, data, tmp_path / "nothing")).weights
    assert torch.equal(alone["head.scores.weight"], untaught["head.scores.weight"])


def test_a_missing_teacher_is_said_before_the_folder_is_made(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", 3)
    with pytest.raises(BundleError, match=r"set train\.teacher"):
        train(with_train(teacher="nowhere"), data, tmp_path / "run")
    assert not (tmp_path / "run" / "config.yaml").exists() and not (data / "prepared").exists()


def test_a_teacher_of_uniform_pillars_looks_where_the_student_looks(tmp_path: Path) -> None:
    uniform = dataclasses.replace(SPEC, grid=dataclasses.replace(SPEC.grid, zones=1))
    save_checkpoint(tmp_path / "teacher.ckpt", tiny_checkpoint("channel", uniform))
    config = with_spec(narrower(uniform))
    taught = dataclasses.replace(config.train, epochs=1, teacher=str(tmp_path / "teacher.ckpt"))
    last = train(dataclasses.replace(config, train=taught), write_dataset(tmp_path / "data", 3), tmp_path / "run")
    assert read_checkpoint(last).steps == 1


def test_fine_tuning_is_taught_by_the_model_that_it_starts_from() -> None:
    config = load_config("fine_tune")
    assert config.train.teacher == "default_float32" and config.train.teacher_weight > 0
    Distillation(config, config.train.teacher)


def test_teachers_that_do_not_fit_are_refused(teacher: str, tmp_path: Path) -> None:
    Distillation(CONFIG, teacher)
    Distillation(with_network(pillar_channels=8, upsample_channels=8), teacher)  # a smaller detector
    for zoned in (narrower(SPEC), dataclasses.replace(SPEC, grid=dataclasses.replace(SPEC.grid, zones=1))):
        with pytest.raises(ConfigError, match=r"teacher\.ckpt: its model\.spec differs"):
            Distillation(with_spec(zoned), teacher)
    ends = dataclasses.replace(SPEC, grid=dataclasses.replace(SPEC.grid, zones=1), anchor_places="ends")
    save_checkpoint(tmp_path / "ends.ckpt", tiny_checkpoint("channel", ends))
    with pytest.raises(ConfigError, match=r"ends\.ckpt: its model\.spec differs"):
        Distillation(with_spec(narrower(ends)), str(tmp_path / "ends.ckpt"))
    with pytest.raises(ConfigError, match=r"teacher\.ckpt: its neck differs"):
        Distillation(with_network(neck="sparse"), teacher)
    with pytest.raises(ConfigError, match=r"train\.teacher = .*only model\.kind pillar"):
        Distillation(dataclasses.replace(CONFIG, model=RefineModel(), augment=STILL_OBJECTS), teacher)
    with pytest.raises(BundleError, match=r"no such bundle or checkpoint; set train\.teacher"):
        Distillation(CONFIG, str(tmp_path / "nowhere"))
