"""The folder of a run: whose it is, that only the same run goes on in it, and only one process at a time."""

import dataclasses
import json
from pathlib import Path
from typing import Any, cast

import pytest
import torch
import yaml

from asca_pillars.base.errors import ConfigError, DatasetError, OutputError, TrainingError
from asca_pillars.base.locks import only_writer
from asca_pillars.base.schema import to_dict
from asca_pillars.base.system import describe_environment
from asca_pillars.config.tree import Config, DataConfig, TrainConfig
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.training import loop
from asca_pillars.training.loop import train
from asca_pillars.training.run_files import YAML_HEAD, require_own_run
from asca_pillars.training.run_folder import TrainingInputs, measure_input, prepare_run_folder
from tests.helpers.in_process import run_here
from tests.helpers.scenes import write_dataset
from tests.helpers.tiny_run import CONFIG, with_train

SEEN = TrainingInputs(2, "ab", 1)
WHOLE = yaml.safe_dump(to_dict(Config()), sort_keys=False)
USERS = {"short": "# my third try\nname: exp1\ntrain: {epochs: 3}\n", "whole": WHOLE, "commented": f"# mine\n{WHOLE}"}


def learn(run: Path) -> None:
    """A run has a checkpoint from its first steps on."""
    (run / "checkpoints").mkdir(parents=True)
    (run / "checkpoints" / "last.ckpt").touch()


def test_a_run_is_the_same_with_other_workers_folders_and_intervals(tmp_path: Path) -> None:
    prepare_run_folder(tmp_path, CONFIG, SEEN)
    data = DataConfig(workers=7, prepared=str(tmp_path))
    recipe = dataclasses.replace(CONFIG.train, checkpoint_steps=9)
    prepare_run_folder(tmp_path, dataclasses.replace(CONFIG, data=data, train=recipe), SEEN)
    learn(tmp_path)
    with pytest.raises(TrainingError, match=r"data\.min_points = 1, now data\.min_points = 2"):
        prepare_run_folder(tmp_path, dataclasses.replace(CONFIG, data=DataConfig(min_points=2)), SEEN)


def test_a_run_goes_on_with_its_own_frames_processes_and_first_weights_alone(tmp_path: Path) -> None:
    prepare_run_folder(tmp_path, CONFIG, SEEN)
    prepare_run_folder(tmp_path, CONFIG, TrainingInputs(2, "ac", 1, "first"))  # nothing is learnt yet
    learn(tmp_path)
    for start in ("first", None, "first"):  # the command is given again, with --init or without it
        prepare_run_folder(tmp_path, CONFIG, TrainingInputs(2, "ac", 1, start))
    for other, message in (
        (TrainingInputs(3, "abc", 1), r"frames\.json: .* on 2 frames, now there are 3, or others; give"),
        (TrainingInputs(2, "ab", 1), r"frames\.json: .* on 2 frames, now there are 2, or others; give"),
        (TrainingInputs(2, "ac", 2), r"started with 1 process\(es\), now 2: .* give as many --devices"),
        (TrainingInputs(2, "ac", 1, "other"), r"was started from other weights; leave --init out"),
    ):
        with pytest.raises(TrainingError, match=message):
            prepare_run_folder(tmp_path, CONFIG, other)
    (tmp_path / "frames.json").write_text("{")
    with pytest.raises(ConfigError, match=r"frames\.json: not valid YAML"):
        prepare_run_folder(tmp_path, CONFIG, SEEN)
    (tmp_path / "expected_input.yaml").write_text("points_per_scan: [")
    with pytest.raises(ConfigError, match=r"expected_input\.yaml: not valid YAML: "):
        measure_input(tmp_path, cast(Any, None), keep=True)  # no frame is asked where something was kept
    (tmp_path / "frames.json").unlink()  # an older version wrote none
    prepare_run_folder(tmp_path, CONFIG, SEEN._replace(initial_sha256=""))
    with pytest.raises(TrainingError, match=r"was started from random weights; leave --init out"):
        prepare_run_folder(tmp_path, CONFIG, SEEN._replace(initial_sha256="other"))


def test_inputs_are_known_by_the_sizes_of_their_scans_and_the_weights(tmp_path: Path) -> None:
    split, weights = KittiSplit(write_dataset(tmp_path, 3), "train"), {"a": torch.ones(2)}
    known = TrainingInputs.of(split, 1, weights)
    assert known == TrainingInputs.of(split, 1, {"a": torch.ones(2)}) and known.frames == 2
    starts = {TrainingInputs.of(split, 1, start).initial_sha256 for start in (weights, {"a": torch.zeros(2)}, {}, None)}
    assert len(starts) == 4 and {"", None} < starts
    split.scan_path("000001").write_bytes(split.scan_path("000001").read_bytes()[16:])
    assert TrainingInputs.of(split, 1, weights).frames_sha256 != known.frames_sha256


def test_a_run_on_other_data_is_refused_before_it_begins(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", 3)
    prepare_run_folder(tmp_path / "run", CONFIG, SEEN)
    (tmp_path / "run" / "checkpoints").mkdir()
    (tmp_path / "run" / "checkpoints" / "best.ckpt").touch()
    with pytest.raises(TrainingError, match=r"frames\.json: .* started on 2 frames, now there are 2, or others"):
        train(CONFIG, data, tmp_path / "run")


def test_a_run_may_be_made_longer_where_its_schedule_allows(tmp_path: Path) -> None:
    def of(**recipe: object) -> Config:
        return dataclasses.replace(CONFIG, train=TrainConfig(batch_size=1, **recipe))  # type: ignore[arg-type]

    stable = {"schedule": "warmup_stable_decay", "cooldown": 0.25}
    seen = TrainingInputs(10, "ab", 1)  # ten steps an epoch: of four stable epochs the last ten steps fall
    step, cycle, falling = (tmp_path / name for name in ("step", "cycle", "falling"))
    prepare_run_folder(step, of(epochs=2, schedule="step"), seen)
    prepare_run_folder(cycle, of(epochs=2, schedule="one_cycle"), seen)
    prepare_run_folder(falling, of(epochs=4, **stable), seen)
    for folder in (step, cycle, falling):
        learn(folder)
    prepare_run_folder(step, of(epochs=5, schedule="step"), seen)
    for folder, config, message in (
        (step, of(epochs=4, schedule="step"), r"train\.epochs = 5, now train\.epochs = 4; choose another"),
        (step, of(epochs=9, schedule="step", seed=1), r"config\.yaml: .* train\.seed = 0, now train\.seed = 1"),
        (cycle, of(epochs=3, schedule="one_cycle"), r"one_cycle schedule is planned .*--init .*last\.ckpt"),
        (falling, of(epochs=8, **stable), r"fallen since step 30 of 40: start .*--init .*last\.ckpt"),
    ):
        with pytest.raises(TrainingError, match=message):
            prepare_run_folder(folder, config, seen, steps=31)
    prepare_run_folder(falling, of(epochs=8, **stable), seen, steps=30)


def test_a_run_that_learnt_nothing_gives_way(tmp_path: Path) -> None:
    """The corrected command may be given again, and nothing of the mistaken one stays."""
    prepare_run_folder(tmp_path, CONFIG, SEEN)
    (tmp_path / "environment.json").write_text("of the mistaken run")
    other = dataclasses.replace(CONFIG, data=DataConfig(min_points=2))
    prepare_run_folder(tmp_path, other, SEEN)
    text = (tmp_path / "config.yaml").read_text()
    assert text.startswith(YAML_HEAD) and yaml.safe_load(text) == to_dict(other)
    assert "torch" in (tmp_path / "environment.json").read_text()


def test_a_run_of_an_older_version_goes_on(tmp_path: Path) -> None:
    """Its config.yaml has no origin, and lacks a setting that came later, not the setting's default."""
    older: Any = to_dict(CONFIG)
    del older["augment"]["insert"], older["model"]["loss"]["score_target"], older["model"]["loss"]["assigner"]
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(older))
    (tmp_path / "environment.json").write_text(json.dumps(describe_environment()))
    (tmp_path / "expected_input.yaml").write_text(
        "camera_view: true\nground_z_m: null\npoints_per_scan: [1, 2]\nreflectance_mean: [0.1, 0.2]\n"
    )
    learn(tmp_path)
    require_own_run(tmp_path)
    path.write_text("# what I learnt\n" + (text := path.read_text()))
    with pytest.raises(OutputError, match=r"config\.yaml"):
        require_own_run(tmp_path)
    path.write_text(text)
    prepare_run_folder(tmp_path, CONFIG, SEEN)


def test_a_folder_in_which_another_process_trains_is_left_to_it(tmp_path: Path) -> None:
    """Before its first checkpoint, too, when its files could be taken for those of a run that never began."""
    data = write_dataset(tmp_path / "data", 3)
    with only_writer(tmp_path / "run", "asca train"):
        prepare_run_folder(tmp_path / "run", CONFIG, SEEN)
        with pytest.raises(OutputError, match=r"run: another `asca train` is at work there; let it end"):
            train(with_train(seed=1), data, tmp_path / "run")
        assert yaml.safe_load((tmp_path / "run" / "config.yaml").read_text()) == to_dict(CONFIG)


def test_a_training_that_cannot_begin_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = write_dataset(tmp_path / "data", 3, val_frames=1)
    with monkeypatch.context() as patch:  # mistyped, and refused before anything is done
        patch.setattr(loop, "DetectionData", lambda *_: pytest.fail("the data were prepared"))
        mistakes: Any = {"init": "nosuch.ckpt"}, {"devices": "many"}
        for mistake in mistakes:
            with pytest.raises(TrainingError, match="|".join(mistake.values())):
                train(CONFIG, data, tmp_path / "run", **mistake)
            assert not (tmp_path / "run").exists()
    KittiSplit(data, "val").calib_path("000002").unlink()
    for root, message in (
        (data, r"calib.000002\.txt: not there \(1 of 2 calibration and label files"),
        (tmp_path, "."),
    ):
        with pytest.raises(DatasetError, match=message):
            train(CONFIG, root, tmp_path / "run")
        assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("content", "given"),
    [("whole", "exp1/../exp1/config.yaml"), ("commented", "link.yaml"), ("short", "other.yaml")],
)
def test_a_configuration_of_the_user_is_not_replaced(tmp_path: Path, content: str, given: str) -> None:
    path = tmp_path / "exp1" / "config.yaml"
    path.parent.mkdir()
    path.write_text(USERS[content])
    (tmp_path / "link.yaml").symlink_to(path)
    (tmp_path / "other.yaml").write_text("name: other\n")
    refused = run_here("train", tmp_path / given, "--data", tmp_path, "--out", path.parent)
    assert refused.returncode > 1 and "holds config.yaml and nothing that `asca train` wrote" in refused.stderr
    assert path.read_text() == USERS[content] and len(list(path.parent.iterdir())) == 1


def test_nor_is_one_that_is_put_into_the_folder_of_a_run(tmp_path: Path) -> None:
    prepare_run_folder(tmp_path, CONFIG, SEEN)
    require_own_run(tmp_path)
    for name in ("config.yaml", "expected_input.yaml", "environment.json", "frames.json"):
        before = (tmp_path / name).read_text() if (tmp_path / name).exists() else None
        (tmp_path / name).write_text("# mine\nname: x\n")
        with pytest.raises(OutputError, match=f"{name}: `asca train` did not write it"):
            require_own_run(tmp_path)
        (tmp_path / name).unlink() if before is None else (tmp_path / name).write_text(before)
    (tmp_path / "config.yaml").write_text(USERS["commented"])
    with pytest.raises(OutputError, match=r"config\.yaml: `asca train` did not write it"):
        prepare_run_folder(tmp_path, CONFIG, SEEN)  # from Python


def test_nothing_is_trained_through_links_or_over_the_weights_to_start_from(tmp_path: Path) -> None:
    run = tmp_path / "run"
    prepare_run_folder(run, CONFIG, SEEN)
    learn(run)
    last = run / "checkpoints" / "last.ckpt"
    require_own_run(run, "asca_sim")
    require_own_run(tmp_path / "other", last)
    with pytest.raises(OutputError, match=r"would replace the input .*last\.ckpt"):
        require_own_run(run, last)
    (run / "tensorboard").mkdir()
    for name in ("checkpoints", "tensorboard", "config.yaml"):
        (run / name).rename(tmp_path / name)
        (run / name).symlink_to(tmp_path / name)
        with pytest.raises(OutputError, match=f"{name}: is a link"):
            require_own_run(run)
        (run / name).unlink()
        (tmp_path / name).rename(run / name)


def test_the_output_of_a_shell_stays_beside_a_run(tmp_path: Path) -> None:
    """`asca train ... > run/train.log`, which the shell opens first."""
    (tmp_path / "train.log").touch()
    require_own_run(tmp_path)
    prepare_run_folder(tmp_path, CONFIG, SEEN)
    (tmp_path / "train.log").write_text("Epoch 1\n")
    require_own_run(tmp_path)
    for name in ("config.yaml", "environment.json", "frames.json"):
        (tmp_path / name).unlink()
    with pytest.raises(OutputError, match=r"holds train\.log and nothing that `asca train` wrote"):
        require_own_run(tmp_path)
