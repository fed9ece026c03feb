"""The ablation's commands in this process."""

import subprocess
from types import SimpleNamespace
from typing import Any, TextIO

import pytest

from asca_pillars.ablation import ablation_runs
from asca_pillars.cli import ablate_steps
from tests.helpers.in_process import run_here


@pytest.fixture
def in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs one after the other, in this process, which has imported torch already."""

    def run(command: list[str], *, stdout: TextIO, **_: object) -> subprocess.CompletedProcess[Any]:
        done = run_here(*command[command.index("asca_pillars.cli") + 1 :])
        stdout.write(done.stdout + done.stderr)
        return done

    # Training answers to Ctrl-C, which only a main thread can.
    monkeypatch.setattr(ablation_runs, "_run_in_threads", lambda todo, work, *_: [work(one) for one in todo])
    monkeypatch.setattr(ablation_runs, "subprocess", SimpleNamespace(run=run, STDOUT=subprocess.STDOUT))
    monkeypatch.setattr(ablate_steps, "TIMED_ROUNDS", 2)
