"""`asca import-weights`: from a file to a checkpoint that the other commands open, or one line that says why not."""

from pathlib import Path

from asca_pillars.models.checkpoint import load_checkpoint
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


def test_refusals_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "text.pth").write_text("text")
    (tmp_path / "last.ckpt").write_text("a training")
    for arguments, message in (
        (("none.pth", "-o", "out.ckpt"), "none.pth: no such file"),
        (("text.pth", "-o", "out.ckpt"), "text.pth: damaged, or holds more than weights"),
        (("text.pth", "-o", "out.pth"), "out.pth: give a name that ends in .ckpt"),
        (("text.pth", "-o", "last.ckpt"), "last.ckpt: is there already"),
    ):
        done = run_here("import-weights", *arguments, cwd=tmp_path)
        assert done.returncode > 1 and done.stderr.startswith(f"asca: {message}"), done.stderr
        assert done.stderr.count("\n") == 1
