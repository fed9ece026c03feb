"""The README is true: its commands exist with their options, its Python runs, its files are there."""

import re
import shlex
from pathlib import Path

import pytest

from asca_deploy import sample_scan_path
from tests.helpers.documentation import help_of

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def _blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


COMMANDS = [
    shlex.split(line, comments=True)
    for block in _blocks("bash")
    for line in block.splitlines()
    if line.startswith("asca ")
]


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_commands_and_options_exist(command: list[str]) -> None:
    help_text = help_of(command[1])
    for word in command[2:]:
        if word.startswith("-"):
            assert re.search(rf"(^|\s|│){re.escape(word)}\b", help_text), f"{word} is no option of {command[1]}"
        if word.startswith("configs/"):
            assert (ROOT / word).is_file(), word


def test_there_are_commands_to_check() -> None:
    assert {command[1] for command in COMMANDS} >= {"detect", "bench", "doctor", "simulate", "train", "export"}


def test_python_example_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (example,) = _blocks("python")
    (tmp_path / "scan.bin").write_bytes(sample_scan_path().read_bytes())
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "README.md", "exec"), {})
    assert "pillarize" in capsys.readouterr().out


@pytest.mark.parametrize("target", re.findall(r"\]\((?!http)([^)#]+)\)", README))
def test_links_lead_somewhere(target: str) -> None:
    assert (ROOT / target).exists()


def test_the_two_commands_are_marked_for_ci() -> None:
    for mark in ("detect", "tests"):
        assert re.search(rf"<!-- {mark} -->\n```bash\n", README), mark
