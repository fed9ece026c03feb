"""What the command line prints of an error."""

import subprocess
import sys
from pathlib import Path

import pytest

from asca_pillars import cli
from asca_pillars.errors import AscaError, printable


def test_nothing_in_a_message_reaches_the_terminal_as_a_control() -> None:
    assert printable("a\x1b[31mb\nc\x9b\u202e\udc80é") == r"a\x1b[31mb\nc\x9b\u202e\udc80é"


def test_long_messages_lose_their_middle() -> None:
    line = printable("bundle.json: " + "\x1b" * 1_000_000 + "; export it again")
    assert len(line) == 1000
    assert line.startswith("bundle.json: ") and line.endswith("; export it again")
    assert "left out" in line
    assert printable("x" * 1000) == "x" * 1000


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (AscaError("a.pcd: TYPE \x1b[2J\n"), r"asca: a.pcd: TYPE \x1b[2J\n"),
        (MemoryError("Unable to allocate 46.6 GiB"), "asca: not enough memory (Unable to allocate 46.6 GiB); "),
        (RecursionError("deep"), "asca: the input is nested too deeply"),
        (OSError(28, "No space left on device", "runs/last.ckpt"), "asca: runs/last.ckpt: No space left on device"),
    ],
)
def test_errors_are_one_line(
    error: Exception, line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        raise error

    monkeypatch.setattr(cli, "app", fail)
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    printed = capsys.readouterr().err
    assert printed.startswith(line)
    assert printed.count("\n") == 1


def test_a_terminal_that_knows_ascii_only_gets_the_table(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "asca_pillars.cli", "detect", "-o", str(tmp_path / "out")],
        env={"PYTHONIOENCODING": "ascii", "PYTHONPATH": ":".join(sys.path), "PATH": ""},
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr.decode()
    assert b"heading" in done.stdout and b"?" in done.stdout
