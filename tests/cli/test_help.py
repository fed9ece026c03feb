"""Help is even: options in the same panels and short names with one meaning in every command, no ragged lines."""

import shlex
from collections import defaultdict
from pathlib import Path

import click
import yaml
from typer.main import get_command

from asca_pillars.cli.main import app

PANELS = {
    "Input": {"--bundle", "--data"},
    "Sensor": {"--sensor-height", "--axes", "--pose", "--reflectance-scale", "--columns", "--around"},
    "Recording": {
        "--topic",
        "--frame",
        "--track",
        "--rate",
        "--times",
        "--odometry",
        "--foxglove",
        "--rerun",
        "--calib",
    },
    "Output": {"--score", "--pictures", "--write"},
    "Speed": {"--provider", "--precision", "--threads", "--cluster"},
}


def commands() -> dict[str, click.Command]:
    return get_command(app).commands  # type: ignore[attr-defined]


def test_short_names_mean_the_same_everywhere() -> None:
    meanings = defaultdict(set)
    for command in commands().values():
        for option in command.params:
            long = [name for name in option.opts if name.startswith("--")]
            for short in (name for name in option.opts if name.startswith("-") and not name.startswith("--")):
                meanings[short].add(long[0])
    assert meanings["-b"] == {"--bundle"} and meanings["-c"] == {"--config"} and meanings["-d"] == {"--data"}
    assert meanings["-o"] == {"--out"}


def test_options_of_detect_are_in_panels() -> None:
    panels = {option.opts[0]: getattr(option, "rich_help_panel", None) for option in commands()["detect"].params}
    for panel, names in PANELS.items():
        assert {name for name in names if name in panels and panels[name] != panel} == set()
    assert {name for name, panel in panels.items() if panel is None} <= {"scans", "--help"}


def test_paragraphs_are_one_line_each() -> None:
    """Else the terminal breaks lines that are broken already."""
    for name, command in commands().items():
        assert all("\n" not in text for text in (command.help or "").split("\n\n")), name


def test_commands_of_the_container_exist() -> None:
    docker = Path(__file__).parents[2] / "examples" / "docker"
    services = yaml.safe_load((docker / "compose.yaml").read_text())["services"]
    asca, name, *words = shlex.split(services["node"]["command"])
    known = {option for parameter in commands()[name].params for option in parameter.opts}
    assert asca == "asca" and {word for word in words if word.startswith("--")} <= known
    context = docker / services["node"]["build"]["context"]
    assert (context / services["node"]["build"]["dockerfile"]).samefile(docker / "Dockerfile")
    kept = [line[1:] for line in (context / ".dockerignore").read_text().splitlines() if line.startswith("!")]
    assert all((context / path).exists() for path in kept)
