"""The folder of what is computed once per dataset: the object database and the maps of free ground."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from asca_pillars.config import DataConfig
from asca_pillars.errors import DatasetError
from asca_pillars.files import atomic_path, require_own

_NOTE = "Computed from the dataset by `asca prepare` or by a training run. Delete it when no run uses it.\n"


def prepared_folder(root: str | Path, data: DataConfig) -> Path:
    """Where it is for the dataset at `root`: <root>/prepared unless `data.prepared` names another folder."""
    return Path(data.prepared) if data.prepared else Path(root) / "prepared"


def require_writable(folder: Path) -> None:
    """Say before minutes of work that the folder cannot take the result.

    Raises:
        DatasetError: it cannot be written.
        OutputError: it holds other files.
    """
    require_own(folder, "asca prepare", "README.txt", text=_NOTE)
    with writing(folder / "README.txt") as temporary:
        temporary.write_text(_NOTE, encoding="utf-8")


@contextlib.contextmanager
def writing(path: Path) -> Iterator[Path]:
    """`atomic_path`, in a folder that may turn out to be read-only.

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
