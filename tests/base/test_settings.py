"""Reading settings: files, overrides, and mistakes in either that are told in one line."""

import time
from pathlib import Path

import pytest
import yaml

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.settings import MAX_CHARACTERS, parse_yaml, read_settings
from asca_pillars.config.pillar import PillarModel
from asca_pillars.config.tree import load_config
from asca_pillars.sim.simulation import SimulationConfig
from tests.helpers.config_files import refusal, write

BOMB = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join(['*' + before] * 10)}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)


def test_overrides_win(tmp_path: Path) -> None:
    path = write(tmp_path, "train: {epochs: 3, batch_size: 2}\n")
    overrides = (
        *("train.epochs=5", "model.network.cpa=none", "model.spec.grid.zones = 1", "model.spec.grid.v_max_m=0.16"),
        *("augment.scale=[0.9, 1.1]", "data.camera_view=false", "name=a=b", "train.epochs=7"),
    )
    config = load_config(path, overrides)
    assert (config.train.epochs, config.train.batch_size) == (7, 2)  # the last of two wins, the others stay
    assert isinstance(config.model, PillarModel)
    assert (config.model.network.cpa, config.augment.scale, config.data.camera_view) == ("none", (0.9, 1.1), False)
    assert (config.model.spec.grid.nx, config.name) == (432, "a=b")


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("train.epoch=3", "unknown key `train.epoch`; did you mean `epochs`?"),
        ("epochs=3", "unknown key `epochs`; known keys: name, model"),
        ("train.epochs", "`train.epochs`: an override is written key.subkey=value, such as train.epochs=20"),
        ("=3", "an override is written key.subkey=value"),
        ("train.seed.first=3", "`seed` is a value, it has no keys"),
        ("train.epochs.first=3", "`train.epochs` = {'first': 3}: input should be a valid integer"),
        ("train.epochs=", "`train.epochs` = None: input should be a valid integer"),
        ("train.epochs=[", "`train.epochs=[`: the value is not valid YAML"),
        ("name=2026-99-99", "`name=2026-99-99`: the value is not valid YAML"),
        ("train.epochs=0", "train.epochs = 0: must be at least 1"),
        ("model.spec.grid.zones=9", "zones 9 must lie between 1 and 5"),
    ],
)
def test_overrides_that_cannot_be(tmp_path: Path, override: str, message: str) -> None:
    line = refusal(write(tmp_path, "train: {seed: 1}\n"), "model.loss.box_weight=1", override)
    assert message in line and override in line


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("train: {epochs: [", "not valid YAML: "),
        ("train:\n\tepochs: 3\n", "not valid YAML: "),
        ("name: 2026-99-99\n", "not valid YAML: "),
        ("- train\n- model\n", "expected `key: value` lines, found a list"),
        ("just words\n", "expected `key: value` lines, found a str"),
        ("train:\n", "`train` = None: input should be a dictionary"),
        ("model: {spec: {grid: {zones: 9}}}\n", "zones 9 must lie between 1 and 5"),
    ],
)
def test_files_that_cannot_be(tmp_path: Path, text: str, message: str) -> None:
    path = write(tmp_path, text)
    assert refusal(path).startswith(f"{path}: {message}")
    path.write_bytes(b"name: caf\xe9\n")
    assert refusal(path).startswith(f"{path}: not valid YAML: ")
    missing = "cannot be read (No such file or directory); these ship: ablation_small, ablation_two_stage, "
    assert missing in refusal(tmp_path / "missing.yaml") and "cannot be read (Is a directory)" in refusal(tmp_path)


# --- YAML


def test_plain_values() -> None:
    found = parse_yaml("a: [1, 2.5, {b: null}]\nc: yes\nd: |\n  text\n")
    assert found == {"a": [1, 2.5, {"b": None}], "c": True, "d": "text\n"}
    assert parse_yaml("") is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (" " * (MAX_CHARACTERS + 1), f"at most {MAX_CHARACTERS}"),
        (BOMB + "name: *i", "an alias"),
        ("a: 1\nb: 2\na: 3", "line 3: the key a is given twice"),
        ("[" * 2000, "nested deeper"),
        ("a: " + "{a: " * 2000, "nested deeper"),
        ("!!map [a, b]", "expected a mapping"),
        ("!!python/object/apply:os.system [ls]", "could not determine a constructor"),
    ],
)
def test_what_settings_do_not_need_is_refused(text: str, words: str) -> None:
    with pytest.raises((yaml.YAMLError, ValueError), match=words):
        parse_yaml(text)


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
    path.write_text(f"train: {{epochs: {'x' * 90_000}}}")
    assert "train.epochs" in (line := refusal(path)) and len(line) < 400, "a long value is quoted in short"
    path.write_text("#" * 10_000_000)
    with pytest.raises(ConfigError, match="too many for settings"):
        load_config(path)
    assert time.process_time() - start < 5  # a minute and more before; no bar on speed
