"""`asca import-weights` and `average-weights`: a checkpoint that the other commands open, or one line why not."""

from pathlib import Path

import pytest
import torch

from asca_deploy.manifest import load_bundle
from asca_deploy.shipped import find_weights
from asca_pillars.base.locks import recover
from asca_pillars.models.build import load_checkpoint
from asca_pillars.training import average_weights
from tests.helpers.in_process import run_here
from tests.models.openpcdet.foreign_networks import PointPillars, write_foreign


def test_a_file_becomes_a_checkpoint(tmp_path: Path) -> None:
    theirs, out = tmp_path / "theirs.pth", tmp_path / "ours.ckpt"
    network = PointPillars(16, (64, 128, 256), (3, 5, 5), 128, 3)
    write_foreign(theirs, network.state_dict())
    told = run_here("import-weights", theirs, "-o", out)
    assert told.returncode > 1 and not out.exists()
    assert "encode.linear.weight (64, 9); give the model's configuration with --config" in told.stderr
    done = run_here("import-weights", theirs, "-o", out, "-s", "model.network.pillar_channels=16")
    assert done.returncode == 0, done.stderr
    assert f"{len(network.state_dict()) + 1} arrays of" in done.stdout
    assert "as openpcdet_pointpillars_kitti" in done.stdout
    loaded = load_checkpoint(out)
    assert loaded.config.name == "openpcdet_pointpillars" and loaded.steps == 18560


def test_a_model_that_ships_and_a_checkpoint_are_averaged(tmp_path: Path) -> None:
    out = tmp_path / "average.ckpt"
    done = run_here("average-weights", "default", find_weights("default"), "-o", out, "--shares", "0.3,0.7")
    assert done.returncode == 0, done.stderr
    ours, theirs = (load_checkpoint(path) for path in (out, find_weights("default")))
    weights = theirs.detector.state_dict()
    for name, value in ours.detector.state_dict().items():
        torch.testing.assert_close(value, weights[name], msg=name)
    shipped, spec = load_bundle(find_weights("default").parent).spec, ours.config.model.spec
    assert spec.post == shipped.post
    specs = (theirs.config.model.spec, spec, shipped)
    trained, averaged, released = ([one.score_threshold for one in each.classes] for each in specs)
    assert averaged == released != trained


def test_another_command_in_the_folder_removes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As `asca export` does, which begins by removing what killed writers left."""
    monkeypatch.setattr(average_weights, "update_batch_norm", lambda *_, **__: recover(tmp_path))
    out = tmp_path / "average.ckpt"
    done = run_here("average-weights", "default", "default", "-o", out, "--update-bn", tmp_path)
    assert done.returncode == 0, done.stderr
    assert load_checkpoint(out).config.name and [path.name for path in tmp_path.iterdir()] == [out.name]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("import-weights none.pth -o out.ckpt", "none.pth: no such file"),
        ("import-weights text.pth -o out.ckpt", "text.pth: damaged, or holds more than weights"),
        ("import-weights text.pth -o out.pth", "out.pth: give a name that ends in .ckpt"),
        ("import-weights text.pth -o last.ckpt", "last.ckpt: already exists"),
        ("average-weights default -o out.ckpt", "1 checkpoint: give two or more"),
        ("average-weights default default -o out.pth", "out.pth: give a name that ends in .ckpt"),
        ("average-weights default default -o last.ckpt", "last.ckpt: already exists"),
        ("average-weights default default -o out.ckpt --shares a,b", "--shares a,b: give numbers"),
        ("average-weights default fast -o out.ckpt", "fast: holds no weights.ckpt"),
        ("average-weights default default -o out.ckpt --split train", "--split train: names frames of --update-bn"),
        (
            "average-weights default default -o out.ckpt --update-bn none",
            "none/training/velodyne: no *.bin",
        ),
    ],
)
def test_refusals_are_one_line(tmp_path: Path, arguments: str, message: str) -> None:
    (tmp_path / "text.pth").write_text("text")
    (tmp_path / "last.ckpt").write_text("a training")
    done = run_here(*arguments.split(), cwd=tmp_path)
    assert done.returncode > 1 and done.stderr.startswith(f"asca: {message}"), done.stderr
    assert done.stderr.count("\n") == 1
