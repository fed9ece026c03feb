"""What a user sees of a command that cannot go on."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from asca_pillars.base.errors import ENVIRONMENT, INPUT, ScanError
from asca_pillars.cli.run_command import run_command


def raising(error: BaseException) -> Callable[[], None]:
    def command() -> None:
        raise error

    return command


@pytest.fixture(autouse=True)
def _script(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["benchmarks/memory.py"])


@pytest.mark.parametrize(
    ("error", "line", "code"),
    [
        (ScanError("a.pcd: TYPE \x1b[2J\n"), r"asca: a.pcd: TYPE \x1b[2J\n", INPUT),
        (
            MemoryError("Unable to allocate 46.6 GiB"),
            "asca: not enough memory (Unable to allocate 46.6 GiB); ",
            ENVIRONMENT,
        ),
        (RecursionError("deep"), "asca: the input is nested too deeply", INPUT),
        (OSError(28, "No space left on device", "a.ckpt"), "asca: a.ckpt: No space left on device", ENVIRONMENT),
    ],
)
def test_errors_are_one_line(error: Exception, line: str, code: int, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match=str(code)):
        run_command(raising(error), "asca")
    printed = capsys.readouterr().err
    assert printed.startswith(line)
    assert printed.count("\n") == 1


def test_a_script_goes_by_its_own_name(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match=str(INPUT)):
        run_command(raising(ScanError("no such folder")))
    assert capsys.readouterr().err == "memory: no such folder\n"


def test_a_defect_keeps_its_traceback() -> None:
    with pytest.raises(ZeroDivisionError):
        run_command(raising(ZeroDivisionError()))


def test_a_terminal_that_knows_ascii_only_gets_the_table(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "asca_pillars.cli", "detect", "-o", str(tmp_path / "out")],
        env={"PYTHONIOENCODING": "ascii", "PYTHONPATH": ":".join(sys.path), "PATH": ""},
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr.decode()
    assert b"heading" in done.stdout and b"?" in done.stdout
