"""`asca average-weights`: a checkpoint that the other commands open, or one line that says why not."""

from pathlib import Path

import torch

from asca_deploy.shipped import find_weights
from asca_pillars.models.checkpoint import load_checkpoint
from tests.helpers.in_process import run_here


def test_a_model_that_ships_and_a_checkpoint_are_averaged(tmp_path: Path) -> None:
    out = tmp_path / "average.ckpt"
    done = run_here("average-weights", "default", find_weights("default"), "-o", out, "--shares", "0.3,0.7")
    assert done.returncode == 0, done.stderr
    ours, theirs = (load_checkpoint(path).detector.state_dict() for path in (out, find_weights("default")))
    for name, value in ours.items():
        torch.testing.assert_close(value, theirs[name], msg=name)


def test_refusals_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "last.ckpt").write_text("a training")
    for arguments, message in (
        (("default", "-o", "out.ckpt"), "1 checkpoint: give two or more"),
        (("default", "default", "-o", "out.pth"), "out.pth: give a name that ends in .ckpt"),
        (("default", "default", "-o", "last.ckpt"), "last.ckpt: is there already"),
        (("default", "default", "-o", "out.ckpt", "--shares", "a,b"), "--shares a,b: give numbers"),
        (("default", "fast", "-o", "out.ckpt"), "fast: holds no weights.ckpt"),
    ):
        done = run_here("average-weights", *arguments, cwd=tmp_path)
        assert done.returncode > 1 and done.stderr.startswith(f"asca: {message}"), done.stderr
        assert done.stderr.count("\n") == 1
