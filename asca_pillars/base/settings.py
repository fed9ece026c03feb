"""Typed settings from plain data and from YAML: frozen dataclasses in, one-line errors with the remedy out."""

import dataclasses
import difflib
import reprlib
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin

import pydantic
import yaml

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.files import read_text

T = TypeVar("T")

_QUOTE = reprlib.Repr()  # cuts: a value may be as long as its file
_QUOTE.maxstring = _QUOTE.maxother = 80
_UNKNOWN_KEY = ("unexpected_keyword_argument", "extra_forbidden")


def parse(type_: type[T], data: dict[str, Any], source: str) -> T:
    """Build the dataclass `type_` from nested plain values.

    Args:
        type_: a dataclass whose fields are plain values, dataclasses or tuples of them.
        data: what a YAML or JSON file held.
        source: the file or command-line option to name in the error.

    Raises:
        ConfigError: an unknown key (the nearest one that exists is named), a missing or an unusable value.
    """
    try:
        parsed: T = _adapter(type_).validate_python(data)  # type: ignore[arg-type]  # types are hashable
    except ConfigError as error:  # a dataclass that checks its own values
        raise ConfigError(f"{source}: {error}") from None
    except pydantic.ValidationError as error:
        # A misspelt key is reported twice, as missing and as unknown; the latter helps.
        first = min(error.errors(), key=lambda item: item["type"] not in _UNKNOWN_KEY)
        raise ConfigError(f"{source}: {_explain(type_, first)}") from None
    if (flag := _flag_for_number(data, to_dict(parsed))) is not None:
        raise ConfigError(f"{source}: `{flag[0]}` = {str(flag[1]).lower()}: input should be a number") from None
    return parsed


def _flag_for_number(given: Any, taken: Any, path: str = "") -> tuple[str, bool] | None:
    """Return path and value of a boolean where a number was taken, as pydantic converts it; None if there is none."""
    if isinstance(given, dict) and isinstance(taken, dict):
        pairs = [(key, given[key], taken[key]) for key in given if key in taken]
    elif isinstance(given, list | tuple) and isinstance(taken, list):
        pairs = [(index, *pair) for index, pair in enumerate(zip(given, taken, strict=False))]
    else:
        return (path, given) if isinstance(given, bool) and not isinstance(taken, bool | str | None) else None
    found = (_flag_for_number(own, other, f"{path}.{key}".lstrip(".")) for key, own, other in pairs)
    return next((flag for flag in found if flag is not None), None)


def to_dict(settings: Any) -> dict[str, Any]:
    """Return plain values (dict, list, str, int, float, bool, None) of a settings dataclass, for YAML or JSON."""
    plain: dict[str, Any] = _adapter(type(settings)).dump_python(settings, mode="json")  # type: ignore[arg-type]
    return plain


@cache
def _adapter(type_: Any) -> pydantic.TypeAdapter[Any]:
    """Return the adapter of a type, cached because it takes milliseconds to build."""
    return pydantic.TypeAdapter(type_)


def _explain(type_: type, error: Any) -> str:
    unknown = error["type"] in _UNKNOWN_KEY
    location = _without_tags(type_, list(error["loc"]))
    if location[-1:] == ["[key]"] and not unknown:  # pydantic's mark of a mapping's key, as against its value
        location.pop()
    key = ".".join(str(part) for part in location)
    if unknown:
        names = [field.name for field in dataclasses.fields(_type_at(type_, list(error["loc"])[:-1]))]
        nearest = difflib.get_close_matches(str(location[-1]), names, n=1, cutoff=0.5)
        advice = f"did you mean `{nearest[0]}`?" if nearest else f"known keys: {', '.join(names)}"
        return f"unknown key `{key}`; {advice}"
    if error["type"] in ("missing", "missing_argument"):
        return f"missing key `{key}`"
    if error["type"] == "union_tag_invalid":  # every union here is told apart by its members' `kind`
        return f"`{key}.kind` = {_QUOTE.repr(error['ctx']['tag'])}: input should be {error['ctx']['expected_tags']}"
    if error["type"] == "union_tag_not_found":
        return f"`{key}`: input should be a dictionary"
    return f"`{key}` = {_QUOTE.repr(error['input'])}: {error['msg'][0].lower()}{error['msg'][1:]}"


def _without_tags(type_: Any, location: list[Any]) -> list[Any]:
    """Return a path without the tags that pydantic inserts after a union's key."""
    for index, part in enumerate(location[:-1]):
        if not dataclasses.is_dataclass(type_):
            break
        type_ = next((field.type for field in dataclasses.fields(type_) if field.name == part), None)
        if (tag := location[index + 1]) in _members(type_):
            return [*location[: index + 1], *_without_tags(_members(type_)[tag], location[index + 2 :])]
    return location


def _members(type_: Any) -> dict[Any, Any]:
    """Return the dataclasses of a tagged union by tag; none for any other type."""
    if get_origin(type_) is not Annotated:
        return {}
    first, *notes = get_args(type_)
    if tags := [note.tag for note in notes if isinstance(note, pydantic.Tag)]:
        return {tags[0]: first}
    return {tag: member for option in get_args(first) for tag, member in _members(option).items()}


def _type_at(type_: Any, location: list[Any]) -> Any:
    """Return the dataclass that the path `location` leads to from `type_`."""
    for part in location:
        if part in (members := _members(type_)):
            type_ = members[part]
        elif isinstance(part, int):
            type_ = get_args(type_)[0]
        elif not dataclasses.is_dataclass(type_):  # a mapping
            type_ = get_args(type_)[-1]
        else:
            type_ = next(field.type for field in dataclasses.fields(type_) if field.name == part)
        if not dataclasses.is_dataclass(type_) and get_args(type_) and not _members(type_):
            options = [option for option in get_args(type_) if dataclasses.is_dataclass(option)]
            type_ = type_ if not options or type_.__class__.__name__ == "GenericAlias" else options[0]
    return type_


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
