"""Progress bars and remarks on the console, as callbacks of the functions that a command calls."""

from types import TracebackType

from rich.console import Console
from rich.progress import Progress
from rich.status import Status

from asca_pillars.base.errors import printable


def print_remark(console: Console, text: str) -> None:
    """Print a line that the user is to notice; it may quote names of files and topics."""
    console.print(printable(text), style="yellow", soft_wrap=True)


class Bars:
    """Progress bars for the steps reported by a function; pass it as `progress`, in a `with` block.

    Args:
        console: console to draw on.
        transient: remove a bar when its step is done.
    """

    def __init__(self, console: Console, *, transient: bool = False) -> None:
        self._console, self._transient = console, transient
        self._bar: Progress | None = None
        self._step = ""
        self._status: Status | None = None

    def __enter__(self) -> "Bars":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()

    def __call__(self, step: str, done: int, total: int) -> None:
        """Update the bar of a step: `done` of `total` parts are done."""
        if self._bar is None or step != self._step:
            self._stop()
            self._bar, self._step = Progress(console=self._console, transient=self._transient), step
            self._bar.add_task(step, total=total)
            self._bar.start()
        self._bar.update(self._bar.task_ids[0], completed=done, total=total)
        if done >= total:
            self._stop()

    def step(self, text: str) -> None:
        """Show a step of unknown duration."""
        if self._status is None:
            self._stop()
            self._status = self._console.status(text)
            self._status.start()
        self._status.update(text)

    def remark(self, text: str) -> None:
        """Print a line that the user is to notice."""
        print_remark(self._console, text)

    def _stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()
        self._bar = None
        if self._status is not None:
            self._status.stop()
        self._status = None
