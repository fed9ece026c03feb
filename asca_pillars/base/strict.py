"""The base of settings. Geometry has settings, too, and shall not need pydantic, which `schema` parses them with."""

from typing import Any, ClassVar


class Strict:
    """Base of the settings dataclasses: a key that does not exist, or a number that is not finite, is an error."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid", "allow_inf_nan": False}
