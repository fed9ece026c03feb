"""Help is even: options in the same panels and short names with one meaning in every command, no ragged lines."""

import shlex
from collections import defaultdict
from pathlib import Path

import click
import pytest
import yaml
from typer.main import get_command
from typer.testing import CliRunner

from asca_pillars.cli.main import app

PANELS = {
    "Input": "--bundle --data --config --set --init --scans --split --compare",
    "Sensor": "--sensor-height --axes --pose --reflectance-scale --columns --around",
    "Recording": "--topic --frame --track --rate --times --odometry --foxglove --rerun --calib",
    "Output": "--out --json --score --pictures --write --val-share",
    "Speed": "--provider --precision --threads --cluster --workers",
}

ORDER = ("Input", "Sensor", "Recording", "Scenes", "Measurements", "Metrics", "Bundle", "Output", "Speed")


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


def panels_of(command: click.Command) -> dict[str, str | None]:
    """The panel of each option, in their order."""
    options = [one for one in command.params if one.opts[0].startswith("--") and one.opts[0] != "--help"]
    return {option.opts[0]: getattr(option, "rich_help_panel", None) for option in options}


def test_options_are_in_panels() -> None:
    """In all of a command's or in none, the input's first, and the same option in the same one everywhere."""
    for name, command in commands().items():
        panels = panels_of(command)
        if not any(panels.values()):
            assert len(panels) <= 3, name
            continue
        assert all(panels.values()), name
        named = list(dict.fromkeys(panels.values()))
        assert named[0] == "Input" and named == [panel for panel in ORDER if panel in named], name
        for panel, names in PANELS.items():
            if (name, panel) != ("ros2", "Recording"):  # it has no recording, but a live topic
                assert {panels[option] for option in names.split() if option in panels} <= {panel}, name


@pytest.mark.parametrize("columns", [80, 100])
def test_help_has_room_for_the_text(columns: int) -> None:
    """A wide column of types leaves a ragged one of text; paragraphs broken already would be broken again."""
    for name, command in commands().items():
        assert all("\n" not in text for text in (command.help or "").split("\n\n")), name
        text = CliRunner().invoke(app, [name, "--help"], env={"COLUMNS": str(columns), "NO_COLOR": "1"}).output
        boxes = [line for line in text.splitlines() if line.startswith("│")]
        assert all(len(line) <= columns for line in text.splitlines()), name
        continued = [len(line[1:]) - len(line[1:].lstrip()) for line in boxes if line.startswith("│" + " " * 8)]
        assert max(continued, default=0) < 50, name


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
