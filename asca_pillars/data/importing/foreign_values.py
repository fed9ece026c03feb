"""Values of tables that others wrote: used where they are what the format says, else counted and named."""

import reprlib
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

_LARGEST = 1e9  # of any number that is a length or an angle
_LONGEST_TEXT = 200
_QUOTE = reprlib.Repr()
_QUOTE.maxstring = _QUOTE.maxother = _QUOTE.maxlong = 60


class SkippedEntries:
    """What an import cannot use: how much of each kind, and the reason for the first of it."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.first: dict[str, str] = {}

    def add(self, kind: str, place: object, reason: object) -> None:
        """One more.

        Args:
            kind: plural noun.
            place: where it stands.
            reason: why it cannot be used.
        """
        self.counts[kind] += 1
        self.first.setdefault(kind, f"{place}: {reason}")

    def lines(self) -> list[str]:
        """A sentence for each kind."""
        return [f"left out, {kind}: {count}, the first: {self.first[kind]}" for kind, count in self.counts.items()]


def text_of(value: Any, name: str) -> str:
    """A text of one line, blanks at its ends and several in a row removed.

    Raises:
        ValueError: it is none, is empty or longer than a name is, or has characters that cannot be printed.
    """
    text = " ".join(value.split()) if isinstance(value, str) and len(value) <= _LONGEST_TEXT else ""
    if not text or not text.isprintable():
        raise ValueError(f"{name} is {_QUOTE.repr(value)}, no name")
    return text


def whole_number(value: Any, name: str) -> int:
    """A whole number of 64 bits.

    Raises:
        ValueError: it is none.
    """
    number = int(value) if isinstance(value, int | np.integer) and not isinstance(value, bool) else None
    if number is None or not -(2**63) <= number < 2**63:
        raise ValueError(f"{name} is {_QUOTE.repr(value)}, no whole number")
    return number


def numbers(values: Any, count: int | None, name: str) -> NDArray[np.float64]:
    """So many numbers of a list or array (N,), in double precision; with None for the count at least one.

    Raises:
        ValueError: there are others, or one is no number, not finite or of no physical size.
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
    """The value of a row by its name.

    Raises:
        ValueError: the row has none, or is no row.
    """
    if not isinstance(row, dict) or name not in row:
        raise ValueError(f"no `{name}`")
    return row[name]
