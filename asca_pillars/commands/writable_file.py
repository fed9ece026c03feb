"""A file that a command ends with, looked at before the work that goes into it."""

from pathlib import Path

from asca_pillars.files import atomic_path


def require_writable(path: Path | None) -> None:
    """Make sure that minutes of work do not end with a file that cannot be written; None is no file.

    Raises:
        OutputError: a folder or a device is at `path`.
        OSError: nothing can be written there.
    """
    if path is None:
        return
    try:
        with atomic_path(path):
            raise _NotYetError
    except _NotYetError:
        pass


class _NotYetError(Exception):
    """Ends a writing before anything stands under the final name."""
