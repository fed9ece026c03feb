"""Settings as YAML text, and what is refused of it."""

import time
from pathlib import Path

import pytest
import yaml

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.settings import MAX_CHARACTERS, parse_yaml, read_settings
from asca_pillars.config.tree import load_config
from asca_pillars.sim.simulation import SimulationConfig

BOMB = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join(['*' + before] * 10)}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)


def test_plain_values() -> None:
    assert parse_yaml("a: [1, 2.5, {b: null}]\nc: yes\nd: |\n  text\n") == {
        "a": [1, 2.5, {"b": None}],
        "c": True,
        "d": "text\n",
    }
    assert parse_yaml("") is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (BOMB + "name: *i", "an alias"),
        ("a: 1\nb: 2\na: 3", "line 3: the key a is given twice"),
        ("[" * 2000, "nested deeper"),
        ("a: " + "{a: " * 2000, "nested deeper"),
        ("!!map [a, b]", "expected a mapping"),
        ("!!python/object/apply:os.system [ls]", "could not determine a constructor"),
    ],
)
def test_what_settings_do_not_need_is_refused(text: str, words: str) -> None:
    with pytest.raises(yaml.YAMLError, match=words):
        parse_yaml(text)


def test_a_long_text_is_not_read() -> None:
    with pytest.raises(ValueError, match=f"at most {MAX_CHARACTERS}"):
        parse_yaml(" " * (MAX_CHARACTERS + 1))


@pytest.mark.parametrize("text", [f"name:\n  {BOMB.replace(chr(10), chr(10) + '  ')}", "network: " + "[" * 5000])
def test_bombs_in_files_and_overrides_are_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "bomb.yaml"
    path.write_text(text)
    start = time.process_time()
    with pytest.raises(ConfigError, match=r"bomb\.yaml: not valid YAML") as caught:
        read_settings(SimulationConfig, path, (), {})
    assert "\n" not in str(caught.value)
    path.write_text("name: x")
    with pytest.raises(ConfigError, match="not valid YAML"):
        load_config(path, [f"network={'{a: ' * 2000}"])
    path.write_text("#" * 10_000_000)
    with pytest.raises(ConfigError, match="too many for settings"):
        load_config(path)
    assert time.process_time() - start < 5  # a minute and more before; no bar on speed


def test_a_long_value_is_quoted_in_short(tmp_path: Path) -> None:
    path = tmp_path / "long.yaml"
    path.write_text(f"train: {{epochs: {'x' * 90_000}}}")
    with pytest.raises(ConfigError, match=r"train\.epochs") as caught:
        load_config(path)
    assert len(str(caught.value)) < 400
