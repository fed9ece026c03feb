"""Folder of per-dataset caches: the object database and the maps of free ground."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from asca_pillars.base.errors import DatasetError
from asca_pillars.base.files import atomic_path
from asca_pillars.base.own_files import require_own, starting_with
from asca_pillars.config.tree import DataConfig
from asca_pillars.scans.find_scans import PREPARED_FILE, PREPARED_NOTE


def prepared_folder(root: str | Path, data: DataConfig) -> Path:
    """Return the cache folder of the dataset at `root`: <root>/prepared unless `data.prepared` names another."""
    return Path(data.prepared) if data.prepared else Path(root) / "prepared"


def require_writable(folder: Path) -> None:
    """Check before minutes of work that the folder can be written.

    Raises:
        DatasetError: it cannot be written.
        OutputError: it holds other files.
    """
    # Caches of earlier versions have no note of their own.
    notes = (PREPARED_FILE, *(path.relative_to(folder).as_posix() for path in folder.glob(f"*/*/{PREPARED_FILE}")))
    below = [Path(at, name).relative_to(folder) for at, names, _ in os.walk(folder) for name in names]
    require_own(folder, "asca prepare", dict.fromkeys(notes, starting_with(PREPARED_NOTE)), folders=below)
    with writable_atomic_path(folder / PREPARED_FILE) as temporary:
        temporary.write_text(PREPARED_NOTE, encoding="utf-8")


@contextlib.contextmanager
def writable_atomic_path(path: Path) -> Iterator[Path]:
    """Open `atomic_path`, in a folder that may be read-only.

    Raises:
        DatasetError: the file cannot be written.
    """
    try:
        with atomic_path(path) as temporary:
            yield temporary
    except OSError as error:
        raise DatasetError(
            f"{path}: cannot be written ({error.strerror or error}); set data.prepared to a folder that can be"
        ) from None
