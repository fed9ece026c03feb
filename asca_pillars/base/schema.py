"""Typed settings from plain data: frozen dataclasses in, helpful one-line errors out."""

import dataclasses
import difflib
import reprlib
from functools import cache
from typing import Annotated, Any, TypeVar, get_args, get_origin

import pydantic

from asca_pillars.base.errors import ConfigError

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
    flags = (_flag_for_number(value, accepted, f"{path}.{key}".lstrip(".")) for key, value, accepted in pairs)
    return next((flag for flag in flags if flag is not None), None)


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
