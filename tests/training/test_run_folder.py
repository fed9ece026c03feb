"""The folder of a run: only the same run goes on in it, and only one process at a time."""

from pathlib import Path

import pytest
import yaml

from asca_pillars.errors import DatasetError, OutputError, TrainingError
from asca_pillars.locks import only_writer
from asca_pillars.models.checkpoint import load_checkpoint
from asca_pillars.schema import to_dict
from asca_pillars.training.loop import train
from asca_pillars.training.run_folder import Seen, claim
from tests.scenes import write_dataset
from tests.training.test_loop import CONFIG, with_train


def test_another_config_does_not_enter_a_run(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", 3)
    claim(tmp_path / "run", CONFIG, Seen.of([], 1))
    (tmp_path / "run" / "checkpoints").mkdir()
    (tmp_path / "run" / "checkpoints" / "best.ckpt").touch()
    with pytest.raises(TrainingError, match=r"config\.yaml: .* train\.seed = 0, now train\.seed = 1; choose another"):
        train(with_train(seed=1), data, tmp_path / "run")


def test_a_folder_in_which_another_process_trains_is_left_to_it(tmp_path: Path) -> None:
    """Before its first checkpoint, too, when its files could be taken for those of a run that never began."""
    data = write_dataset(tmp_path / "data", 3)
    with only_writer(tmp_path / "run", "asca train"):
        claim(tmp_path / "run", CONFIG, Seen.of([], 1))
        with pytest.raises(OutputError, match=r"run: another `asca train` is at work there; let it end"):
            train(with_train(seed=1), data, tmp_path / "run")
        assert yaml.safe_load((tmp_path / "run" / "config.yaml").read_text()) == to_dict(CONFIG)


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
