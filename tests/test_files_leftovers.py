"""What a killed writer leaves: the next run removes it, and nothing else."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from asca_pillars.base.files import atomic_directory, atomic_path
from asca_pillars.base.locks import recover
from asca_pillars.base.own_files import require_replaceable
from tests.helpers.bundle_folder import EXPORT, names, old_bundle

linux = pytest.mark.skipif(sys.platform != "linux", reason="locks")


KILLED = """
import os, signal, sys
from asca_pillars.base.files import atomic_directory, atomic_path
from asca_pillars.base.own_files import json_object
place, kind = sys.argv[1:]
if kind == "file":
    with atomic_path(place + "/last.ckpt") as temporary:
        temporary.write_text("half")
        os.kill(os.getpid(), signal.SIGKILL)
if kind == "two steps":
    replace = os.replace
    def kill_before_the_second(source, target):
        if os.path.basename(target) == "bundle":
            os.kill(os.getpid(), signal.SIGKILL)
        replace(source, target)
    os.replace = kill_before_the_second
with atomic_directory(place + "/bundle", "asca export", "bundle.json", json_object("file")) as temporary:
    (temporary / "bundle.json").write_text("new")
    if kind == "folder":
        os.kill(os.getpid(), signal.SIGKILL)
"""


@linux
@pytest.mark.parametrize("kind", ["file", "folder", "two steps"])
def test_the_next_run_clears_up_after_a_killed_one(tmp_path: Path, kind: str) -> None:
    old_bundle(tmp_path / "bundle")
    done = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path), kind], check=False)
    assert done.returncode == -signal.SIGKILL
    assert (tmp_path / "bundle").exists() == (kind != "two steps")
    assert len(names(tmp_path)) == 2
    require_replaceable(tmp_path / "bundle", *EXPORT)  # every command begins with it, or with another call of `recover`
    assert names(tmp_path) == ["bundle"]
    assert (tmp_path / "bundle" / "a.onnx").read_text() == "old"


@linux
def test_what_is_being_written_is_no_leftover(tmp_path: Path) -> None:
    (tmp_path / ".notes.asca-1234567.txt").write_text("a name of somebody else")
    with atomic_path(tmp_path / "a.txt") as one, atomic_directory(tmp_path / "b", *EXPORT) as two:
        one.write_text("half")
        recover(tmp_path)
        assert one.exists() and two.exists()
    assert names(tmp_path) == [".notes.asca-1234567.txt", "a.txt", "b"]
