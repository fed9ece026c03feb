"""The ablation's commands in this process, one after the other."""

import subprocess
from types import SimpleNamespace
from typing import TextIO

import pytest

from asca_pillars.ablation import variants
from tests.in_process import run_here


@pytest.fixture
def commands_here(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(command: list[str], *, stdout: TextIO, **_: object) -> subprocess.CompletedProcess[str]:
        done = run_here(*command[command.index("asca_pillars.cli") + 1 :])
        stdout.write(done.stdout + done.stderr)
        return done

    # Training answers to Ctrl-C, which only a main thread can.
    monkeypatch.setattr(variants, "_at_once", lambda todo, work, *_: [work(one) for one in todo])
    monkeypatch.setattr(variants, "subprocess", SimpleNamespace(run=run, STDOUT=subprocess.STDOUT))
