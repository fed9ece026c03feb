"""Validation of values from tables of other programs; invalid ones are counted and reported."""

import reprlib
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

_LARGEST = 1e9  # of any length or angle
_LONGEST_TEXT = 200
_QUOTE = reprlib.Repr()
_QUOTE.maxstring = _QUOTE.maxother = _QUOTE.maxlong = 60


class SkippedEntries:
    """Counts of unusable data by kind, with the reason for the first of each kind."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.first: dict[str, str] = {}

    def add(self, kind: str, place: object, reason: object) -> None:
        """Count one more.

        Args:
            kind: plural noun.
            place: its location.
            reason: why it cannot be used.
        """
        self.counts[kind] += 1
        self.first.setdefault(kind, f"{place}: {reason}")

    def lines(self) -> list[str]:
        """Return a sentence for each kind."""
        return [f"left out, {kind}: {count}, the first: {self.first[kind]}" for kind, count in self.counts.items()]


def text_of(value: Any, name: str) -> str:
    """Return a text of one line with whitespace normalized.

    Raises:
        ValueError: it is not text, empty, longer than a name, or has unprintable characters.
    """
    text = " ".join(value.split()) if isinstance(value, str) and len(value) <= _LONGEST_TEXT else ""
    if not text or not text.isprintable():
        raise ValueError(f"{name} is {_QUOTE.repr(value)}, no name")
    return text


def whole_number(value: Any, name: str) -> int:
    """Return an integer of 64 bits.

    Raises:
        ValueError: it is not one.
    """
    number = int(value) if isinstance(value, int | np.integer) and not isinstance(value, bool) else None
    if number is None or not -(2**63) <= number < 2**63:
        raise ValueError(f"{name} is {_QUOTE.repr(value)}, not a whole number")
    return number


def numbers(values: Any, count: int | None, name: str) -> NDArray[np.float64]:
    """Return `count` numbers of a list or array (N,) in double precision; None: at least one.

    Raises:
        ValueError: the count differs, or one is not a number, not finite or of no physical size.
    """
    if isinstance(values, np.ndarray) and values.dtype.kind in "iuf":
        array = values.astype(np.float64)
    elif isinstance(values, list | tuple | np.ndarray):
        plain: list[Any] = [value for value in values if isinstance(value, int | float | np.integer | np.floating)]
        usual = [float(value) for value in plain if not isinstance(value, bool) and abs(value) <= _LARGEST]
        array = np.array(usual if len(usual) == len(values) else [np.nan])
    else:
        array = np.zeros(0)
    if array.ndim != 1 or len(array) != (count or max(len(array), 1)) or not (np.abs(array) <= _LARGEST).all():
        raise ValueError(f"{name} is {_QUOTE.repr(values)}, not {count or 'some'} finite numbers")
    return array


def entry(row: Any, name: str) -> Any:
    """Return the value of a row by its name.

    Raises:
        ValueError: the row has none, or is not a row.
    """
    if not isinstance(row, dict) or name not in row:
        raise ValueError(f"no `{name}`")
    return row[name]
