"""Base class of settings, and checks of bounds; free of pydantic, for `geometry`."""

import math
import reprlib
from collections.abc import Sequence
from typing import Any, ClassVar

from asca_pillars.base.errors import ConfigError


class Strict:
    """Base of the settings dataclasses: a key that does not exist, or a number that is not finite, is an error."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid", "allow_inf_nan": False}


_LARGEST = 2.0**53  # largest number in settings: up to here a float holds every integer


def require_bounds(section: str, settings: Strict, names: Sequence[str], *, low: float, high: float = math.inf) -> None:
    """Refuse numbers, alone or in a tuple that has at least one, below `low`, above `high` or not finite.

    Args:
        section: where the settings stand in a configuration, for the message.
        settings: that hold the numbers.
        names: of their fields.
        low, high: smallest and largest value that is allowed.

    Raises:
        ConfigError: with the key, the value and the bound.
    """
    for name in names:
        value = getattr(settings, name)
        if value == ():
            raise ConfigError(f"{section}.{name} is empty: give at least one number")
        for number in value if isinstance(value, tuple) else (value,):
            # Compared, never converted: a whole number may be larger than any float.
            if abs(number) > _LARGEST and number != math.inf:
                raise ConfigError(f"{section}.{name} = {reprlib.repr(number)}: must be at most {_LARGEST:g}")
            if not low <= number <= high or number == math.inf:
                bounds = f"be at least {low:g}" if high == math.inf else f"lie between {low:g} and {high:g}"
                raise ConfigError(f"{section}.{name} = {number:g}: must {bounds}")
