"""docs/OWN_CLASSES.md as a newcomer follows it: every block in order, with fewer frames and steps."""

import json
import re
import shlex
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from asca_pillars.cli.main import app

PAGE = (Path(__file__).parent.parent / "docs" / "OWN_CLASSES.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```(bash|python|yaml)\n(.*?)```", PAGE, flags=re.DOTALL)
SHORTER = {"-n 200": "-n 24 -w 1", "000180": "000023"}


def test_every_line_of_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    ran = []
    for language, block in BLOCKS:
        if language == "python":
            exec(compile(block, "OWN_CLASSES.md", "exec"), {})
        elif language == "yaml":
            settings = yaml.safe_load(block)
            settings["train"] |= {"epochs": 1}
            Path("tiny.yaml").write_text(yaml.safe_dump(settings))
        else:
            ran += [_run(line) for line in block.splitlines() if line.startswith("asca ")]
    assert ran == ["simulate", "import", "inspect", "train", "eval", "export", "detect"]
    config = yaml.safe_load(Path("own.yaml").read_text())
    assert "Forklift" in [one["name"] for one in config["model"]["spec"]["classes"]]
    assert len(list(Path("inspection").glob("*.png"))) == 4
    report = json.loads(Path("evaluation/iou.json").read_text())
    assert {row["class_name"] for row in report["at_score"]} >= {"Car", "Forklift"}
    assert json.loads(Path("own_bundle/bundle.json").read_text())["expected_input"]["camera_view"] is False
    assert Path("detections/000023_bev.png").exists()
    assert not list(Path().glob("own/**/calib"))  # no camera anywhere in the new dataset


def _run(line: str) -> str:
    for long, short in SHORTER.items():
        line = line.replace(long, short)
    _, *arguments = shlex.split(line, comments=True)
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, f"{line}\n{result.output}"
    return arguments[0]
