"""The folder of a run: only the same run goes on in it, and only one process at a time."""

from pathlib import Path

import pytest
import yaml

from asca_pillars.base.errors import DatasetError, OutputError, TrainingError
from asca_pillars.base.locks import only_writer
from asca_pillars.base.schema import to_dict
from asca_pillars.data.kitti import KittiSplit
from asca_pillars.models.checkpoint import load_checkpoint
from asca_pillars.training.loop import train
from asca_pillars.training.run_folder import TrainingInputs, claim_run_folder
from tests.helpers.scenes import write_dataset
from tests.helpers.tiny_run import CONFIG, with_train


def test_another_config_does_not_enter_a_run(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", 3)
    claim_run_folder(tmp_path / "run", CONFIG, TrainingInputs(0, "", 1))
    (tmp_path / "run" / "checkpoints").mkdir()
    (tmp_path / "run" / "checkpoints" / "best.ckpt").touch()
    with pytest.raises(TrainingError, match=r"config\.yaml: .* train\.seed = 0, now train\.seed = 1; choose another"):
        train(with_train(seed=1), data, tmp_path / "run")


def test_a_folder_in_which_another_process_trains_is_left_to_it(tmp_path: Path) -> None:
    """Before its first checkpoint, too, when its files could be taken for those of a run that never began."""
    data = write_dataset(tmp_path / "data", 3)
    with only_writer(tmp_path / "run", "asca train"):
        claim_run_folder(tmp_path / "run", CONFIG, TrainingInputs(0, "", 1))
        with pytest.raises(OutputError, match=r"run: another `asca train` is at work there; let it end"):
            train(with_train(seed=1), data, tmp_path / "run")
        assert yaml.safe_load((tmp_path / "run" / "config.yaml").read_text()) == to_dict(CONFIG)


def test_other_data_with_the_same_numbers_are_other_frames(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", 3)
    train(CONFIG, data, tmp_path / "run")
    scan = KittiSplit(data, "train").scan_path("000001")
    scan.write_bytes(scan.read_bytes()[16:])
    with pytest.raises(TrainingError, match=r"frames\.json: .* started on 2 frames, now there are 2, or others"):
        train(CONFIG, data, tmp_path / "run")


def test_a_run_goes_on_with_the_weights_that_it_started_from_alone(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", 3)
    first, other = (train(with_train(seed=seed), data, tmp_path / f"first{seed}") for seed in (1, 2))
    for init in (first, first, None):  # the command is given again, with the option or without it
        train(CONFIG, data, tmp_path / "run", init=init)
    with pytest.raises(TrainingError, match=r"frames\.json: .* was started from other weights; leave --init out"):
        train(CONFIG, data, tmp_path / "run", init=other)
    with pytest.raises(TrainingError, match=r"frames\.json: .* was started from random weights; leave --init out"):
        train(with_train(seed=1), data, tmp_path / "first1", init=other)


def test_files_that_are_missing_are_told_before_the_run_begins(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", 3, val_frames=1)
    KittiSplit(data, "val").calib_path("000002").unlink()
    with pytest.raises(DatasetError, match=r"calib.000002\.txt: not there \(1 of 2 calibration and label files"):
        train(CONFIG, data, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_training_that_cannot_begin_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(DatasetError):
        train(CONFIG, tmp_path / "nowhere", tmp_path / "runs" / "run")
    assert not (tmp_path / "runs" / "run").exists()


def test_a_run_of_an_older_version_goes_on(tmp_path: Path) -> None:
    """Its config.yaml lacks a setting that came later, not the setting's default."""
    data = write_dataset(tmp_path / "data", 3)
    first = train(CONFIG, data, tmp_path / "run")
    path = tmp_path / "run" / "config.yaml"
    older = yaml.safe_load(path.read_text())
    del older["augment"]["insert"], older["model"]["loss"]["score_target"], older["model"]["loss"]["assigner"]
    path.write_text(yaml.safe_dump(older))
    steps = load_checkpoint(first).steps
    assert load_checkpoint(train(CONFIG, data, tmp_path / "run")).steps == steps
