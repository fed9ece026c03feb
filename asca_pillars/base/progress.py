"""Progress and remarks of long work, passed to callbacks and never printed."""

from collections.abc import Callable, Iterable, Iterator
from typing import TypeAlias, TypeVar

Item = TypeVar("Item")

Progress: TypeAlias = Callable[[str, int, int], None]
"""Called with the name of a step, how many parts of it are done, and how many there are."""
Remark: TypeAlias = Callable[[str], None]
"""Called with a sentence for the user, as soon as it is known."""


class Reporter:
    """Passes progress and remarks on to the callbacks of a public function.

    Args:
        progress: None for none.
        remark: None for none.

    Attributes:
        remarks: all remarks so far, for the result of the function.
    """

    def __init__(self, progress: Progress | None = None, remark: Remark | None = None) -> None:
        self._progress, self._remark = progress, remark
        self.remarks: list[str] = []

    def remark(self, text: str) -> None:
        """Tell and keep a sentence."""
        self.remarks.append(text)
        if self._remark is not None:
            self._remark(text)

    def progress(self, step: str, done: int, total: int) -> None:
        """Tell how many of the parts of a step are done."""
        if self._progress is not None:
            self._progress(step, done, total)

    def track(self, items: Iterable[Item], step: str, total: int | None = None, done: int = 0) -> Iterator[Item]:
        """Yield the items; after each one the progress callback is called.

        Args:
            items: to pass on.
            step: name for the callback.
            total: number of items, if they have no length; includes `done`.
            done: items that were done before.
        """
        if self._progress is None:
            yield from items
            return
        total = len(items) if total is None else total  # type: ignore[arg-type]  # else the caller gives it
        if total > done:
            self._progress(step, done, total)
        for number, item in enumerate(items, start=done + 1):
            yield item
            self._progress(step, number, max(total, number))


SILENT = Reporter()
"""Reporter without callbacks; for functions that only track."""
