"""Settings from YAML files: those that ship by name, and `key.subkey=value` overrides."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.files import read_text
from asca_pillars.base.schema import parse, to_dict

MAX_CHARACTERS, MAX_DEPTH = 100_000, 30


def parse_yaml(text: str) -> Any:
    """Parse a YAML text into dicts, lists, strings, numbers, booleans, dates or None.

    Raises:
        yaml.YAMLError: no valid YAML, or YAML with what settings do not need: aliases (ten lines of them can stand for
            more values than memory holds), a key that is given twice, nesting of more than MAX_DEPTH levels.
        ValueError: more than MAX_CHARACTERS, or a number or date that there is not.
    """
    if len(text) > MAX_CHARACTERS:
        raise ValueError(f"{len(text)} characters, at most {MAX_CHARACTERS} are read")
    return yaml.load(text, Loader=_Loader)  # noqa: S506  # a SafeLoader


class _Loader(yaml.SafeLoader):
    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError(f"line {self.peek_event().start_mark.line + 1}: an alias; write the value itself")
        if self.depth == MAX_DEPTH:
            raise yaml.YAMLError(f"line {self.peek_event().start_mark.line + 1}: nested deeper than {MAX_DEPTH} levels")
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[tuple[str, str]] = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            name = (key.tag, str(key.value))
            if name in seen:
                raise yaml.YAMLError(f"line {key.start_mark.line + 1}: the key {name[1]} is given twice")
            seen.add(name)
        return super().construct_mapping(node, deep)


T = TypeVar("T")


def shipped_configs(kind: str = "") -> dict[str, Path]:
    """Return the shipped configurations by name: those of the installed package, or of the checkout.

    Args:
        kind: folder below configs/ for those of something else than a model.
    """
    package = Path(__file__).parents[1]
    folders = (package / "configs" / kind, package.parent / "configs" / kind)
    return {path.stem: path for folder in folders for path in sorted(folder.glob("*.yaml"))}


def read_settings(type_: type[T], path: str | Path, overrides: Sequence[str], shipped: Mapping[str, Path]) -> T:
    """Read the settings of a dataclass from a YAML file that holds what differs from its defaults.

    Args:
        type_: the dataclass.
        path: the YAML file, or one of the names in `shipped`.
        overrides: `key.subkey=value` texts, value in YAML notation; they win over the file.
        shipped: names that stand for files.

    Raises:
        ConfigError: unreadable YAML, an unknown key anywhere (the nearest is named), an impossible value.
    """
    path = shipped.get(str(path), Path(path))
    try:
        if path.stat().st_size > 4 * MAX_CHARACTERS:  # a character has up to four bytes
            raise ConfigError(f"{path}: {path.stat().st_size} bytes are too many for settings; give another file")
        data = parse_yaml(read_text(path, ConfigError))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); these ship: {', '.join(shipped)}") from None
    except (yaml.YAMLError, ValueError) as error:  # ValueError: not UTF-8, or a date like 2026-99-99
        raise ConfigError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from None
    if data is None:
        data = {}
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: expected `key: value` lines, found a {type(data).__name__}")
    settings = parse(type_, data, str(path))
    if not overrides:
        return settings
    for override in overrides:
        _apply(data, override)
    return parse(type_, data, f"{path} with {' '.join(overrides)}")


def with_overrides(settings: T, overrides: Sequence[str], source: str) -> T:
    """Return settings with other values.

    Args:
        settings: a dataclass.
        overrides: `key.subkey=value` texts, value in YAML notation.
        source: the command-line option to name in the error.

    Raises:
        ConfigError: an unknown key anywhere (the nearest is named), an impossible value.
    """
    data = to_dict(settings)
    for override in overrides:
        _apply(data, override)
    return parse(type(settings), data, source)


def _apply(data: dict[str, Any], override: str) -> None:
    """Set `key.subkey=value` in the nested dictionary `data`."""
    key, separator, text = override.partition("=")
    if not separator or not key:
        raise ConfigError(f"`{override}`: an override is written key.subkey=value, such as train.epochs=20")
    *parents, leaf = key.strip().split(".")
    for parent in parents:
        data = data.setdefault(parent, {})
        if not isinstance(data, dict):
            raise ConfigError(f"`{override}`: `{parent}` is a value, it has no keys")
    try:
        data[leaf] = parse_yaml(text)
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(f"`{override}`: the value is not valid YAML: {' '.join(str(error).split())}") from None
