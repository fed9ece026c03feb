"""What the rows of an ablation have in common: they vary one base configuration, and stand in tables."""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol


class Row(Protocol):
    """A variant: what it changes in the base configuration."""

    @property
    def name(self) -> str:
        """Of the variant."""

    @property
    def overrides(self) -> tuple[str, ...]:
        """For `asca train -s`."""

    @property
    def components(self) -> tuple[str, ...]:
        """Cells of the table's first columns."""

    def misfit(self, model: Any) -> str | None:
        """Why the row would change more of a base's `model` than its cells say; None if it would not."""


class Family(NamedTuple):
    """The ablation of one family of detectors."""

    variants: Mapping[str, Row]
    """By name, the baseline first."""
    tables: Mapping[str, tuple[str, ...]]
    """Names of the rows of each table, by its title."""
    components: tuple[str, ...]
    """Heads of the columns that say what a row has."""
