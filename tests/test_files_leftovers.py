"""What a killed writer leaves: the next run removes it, and nothing else."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from asca_pillars import files
from asca_pillars.files import atomic_directory, atomic_path, recover
from tests.bundle_folder import EXPORT, names, old_bundle

linux = pytest.mark.skipif(sys.platform != "linux", reason="locks and renameat2")


@pytest.fixture(autouse=True)
def no_folder_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a new process, which looks for leftovers once."""
    monkeypatch.setattr(files, "_cleared", set())


KILLED = """
import os, signal, sys
from asca_pillars import files
from asca_pillars.files import atomic_directory, atomic_path
place, kind = sys.argv[1:]
if kind == "file":
    with atomic_path(place + "/last.ckpt") as temporary:
        temporary.write_text("half")
        os.kill(os.getpid(), signal.SIGKILL)
if kind == "two steps":
    files._exchange = lambda *_: False
    replace = os.replace
    def kill_before_the_second(source, target):
        if os.path.basename(target) == "bundle":
            os.kill(os.getpid(), signal.SIGKILL)
        replace(source, target)
    os.replace = kill_before_the_second
with atomic_directory(place + "/bundle", "asca export", "bundle.json") as temporary:
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
    with atomic_path(tmp_path / "other.txt") as temporary:
        temporary.write_text("next")
    assert names(tmp_path) == ["bundle", "other.txt"]
    assert (tmp_path / "bundle" / "a.onnx").read_text() == "old"


@linux
def test_what_is_being_written_is_no_leftover(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / ".notes.asca-1234567.txt").write_text("a name of somebody else")
    with atomic_path(tmp_path / "a.txt") as one, atomic_directory(tmp_path / "b", *EXPORT) as two:
        one.write_text("half")
        files._cleared.clear()
        recover(tmp_path)
        assert one.exists() and two.exists()
    assert names(tmp_path) == [".notes.asca-1234567.txt", "a.txt", "b"]


def test_a_worker_beside_those_of_other_machines_clears_nothing_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The locks of another machine may not be seen here."""
    monkeypatch.setattr(files, "_shares_folders", False)
    recover(tmp_path)
    left = tmp_path / ".a.asca-00000000.txt"
    left.touch()
    recover(tmp_path)
    assert left.exists(), "once a process"
    files.share_folders()
    recover(tmp_path, again=True)
    files._cleared.clear()
    with atomic_path(tmp_path / "b.txt") as path:
        path.write_text("b")
    assert left.exists()
    monkeypatch.setattr(files, "_shares_folders", False)
    recover(tmp_path, again=True)
    assert [path.name for path in tmp_path.iterdir()] == ["b.txt"]
