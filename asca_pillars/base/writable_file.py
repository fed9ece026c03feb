"""Check of an output file before the work whose result it will hold."""

from collections.abc import Iterable
from pathlib import Path

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.files import atomic_path
from asca_pillars.base.locks import recover
from asca_pillars.base.own_files import Recognizer, require_own_file


def require_writable(
    path: Path | None, command: str, is_own: Recognizer, inputs: Iterable[str | Path | None] = ()
) -> None:
    """Make sure that a file can be written before minutes of work; None means no file.

    Arguments and errors: as of `require_own_file`.
    """
    if path is None:
        return
    recover(path.parent)
    require_own_file(path, command, is_own, inputs)
    try:
        with atomic_path(path):
            raise _NotYetError
    except _NotYetError:
        pass


def require_suffix(option: str, path: Path, suffix: str) -> None:
    """Refuse a name by which a viewer would not open the file, with a ConfigError."""
    if path.suffix.lower() != suffix:
        raise ConfigError(f"{option} {path}: viewers open {suffix} files; choose such a name")


class _NotYetError(Exception):
    """Aborts a write before anything stands under the final name."""
