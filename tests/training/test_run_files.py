"""Whose the folder of a run is: a configuration that a user wrote there is not replaced."""

import json
from pathlib import Path

import pytest
import yaml

from asca_pillars.base.errors import OutputError
from asca_pillars.base.schema import to_dict
from asca_pillars.base.system import describe_environment
from asca_pillars.config.tree import Config
from asca_pillars.training.run_files import YAML_HEAD, require_own_run
from asca_pillars.training.run_folder import TrainingInputs, claim_run_folder
from tests.helpers.in_process import run_here
from tests.helpers.tiny_run import CONFIG

USERS = {
    "short": "# my third try\nname: exp1\ntrain: {epochs: 3}\n",
    "whole": yaml.safe_dump(to_dict(Config()), sort_keys=False),
    "commented": "# mine\n" + yaml.safe_dump(to_dict(Config()), sort_keys=False),
}


@pytest.mark.parametrize("content", USERS)
@pytest.mark.parametrize("given", ["exp1/config.yaml", "exp1/../exp1/config.yaml", "link.yaml", "other.yaml"])
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
    claim_run_folder(tmp_path, CONFIG, TrainingInputs(0, "", 1))
    require_own_run(tmp_path)
    for name in ("config.yaml", "expected_input.yaml", "environment.json", "frames.json"):
        before = (tmp_path / name).read_text() if (tmp_path / name).exists() else None
        (tmp_path / name).write_text("# mine\nname: x\n")
        with pytest.raises(OutputError, match=f"{name}: `asca train` did not write it"):
            require_own_run(tmp_path)
        (tmp_path / name).unlink() if before is None else (tmp_path / name).write_text(before)
    (tmp_path / "config.yaml").write_text(USERS["commented"])
    with pytest.raises(OutputError, match=r"config\.yaml: `asca train` did not write it"):
        claim_run_folder(tmp_path, CONFIG, TrainingInputs(0, "", 1))  # from Python


def test_the_folder_of_an_older_version_s_run_is_one(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(USERS["whole"])
    (tmp_path / "environment.json").write_text(json.dumps(describe_environment()))
    (tmp_path / "expected_input.yaml").write_text(
        "camera_view: true\nground_z_m: null\npoints_per_scan: [1, 2]\nreflectance_mean: [0.1, 0.2]\n"
    )
    require_own_run(tmp_path)
    (tmp_path / "config.yaml").write_text("# what I learnt\n" + USERS["whole"])
    with pytest.raises(OutputError, match=r"config\.yaml"):
        require_own_run(tmp_path)


def test_what_a_run_writes_says_so(tmp_path: Path) -> None:
    claim_run_folder(tmp_path, CONFIG, TrainingInputs(0, "", 1))
    text = (tmp_path / "config.yaml").read_text()
    assert text.startswith(YAML_HEAD) and yaml.safe_load(text) == to_dict(CONFIG)


@pytest.mark.parametrize("name", ["checkpoints", "tensorboard", "config.yaml"])
def test_nothing_is_trained_through_links(tmp_path: Path, name: str) -> None:
    run, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    claim_run_folder(run, CONFIG, TrainingInputs(0, "", 1))
    elsewhere.mkdir()
    (run / name).unlink(missing_ok=True)
    (run / name).symlink_to(elsewhere)
    with pytest.raises(OutputError, match=f"{name}: is a link"):
        require_own_run(run)


def test_weights_to_start_from_are_not_those_that_the_run_replaces(tmp_path: Path) -> None:
    claim_run_folder(tmp_path / "run", CONFIG, TrainingInputs(0, "", 1))
    best = tmp_path / "run" / "checkpoints" / "best.ckpt"
    best.parent.mkdir()
    best.touch()
    require_own_run(tmp_path / "run", "asca_sim")
    require_own_run(tmp_path / "other", best)
    with pytest.raises(OutputError, match=r"would replace .*best\.ckpt, which is read"):
        require_own_run(tmp_path / "run", best)


def test_the_output_of_a_shell_stays_beside_a_run(tmp_path: Path) -> None:
    """`asca train ... > run/train.log`, which the shell opens first."""
    (tmp_path / "train.log").touch()
    require_own_run(tmp_path)
    claim_run_folder(tmp_path, CONFIG, TrainingInputs(0, "", 1))
    (tmp_path / "train.log").write_text("Epoch 1\n")
    require_own_run(tmp_path)
    (tmp_path / "config.yaml").unlink()
    (tmp_path / "environment.json").unlink()
    (tmp_path / "frames.json").unlink()
    with pytest.raises(OutputError, match=r"holds train\.log and nothing that `asca train` wrote"):
        require_own_run(tmp_path)
