"""Check that an input path is a regular file with content of its own, before it is read."""

import stat
from pathlib import Path

from asca_pillars.base.errors import AscaError

_LFS_POINTER = b"version https://git-lfs"
_LARGEST_POINTER_BYTES = 1024  # as Git LFS defines its pointers
_KINDS = (
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def require_content(path: str | Path, error: type[AscaError]) -> None:
    """Make sure that reading a file ends and gives the file's own content.

    A missing path, or a folder, is left to the caller's `open`.

    Args:
        path: of the file; links are followed.
        error: what is raised.

    Raises:
        AscaError: of the type `error`, if it is a pipe, a socket or a device, or a pointer that Git LFS left in the
            place of the file.
        OSError: the file cannot be opened.
    """
    try:
        status = Path(path).stat()
    except (FileNotFoundError, NotADirectoryError):
        return
    for is_kind, name in _KINDS:
        if is_kind(status.st_mode):
            raise error(f"{path}: is {name} and no regular file; write its content to a file and give that")
    if stat.S_ISREG(status.st_mode) and status.st_size <= _LARGEST_POINTER_BYTES:
        with Path(path).open("rb") as file:
            if file.read(len(_LFS_POINTER)) == _LFS_POINTER:
                raise error(f"{path}: is a pointer of Git LFS, its content was not fetched; run `git lfs pull`")


def read_text(path: str | Path, error: type[AscaError], *, errors: str = "strict") -> str:
    """Read a file that `require_content` accepts as UTF-8 text, without a byte-order mark.

    Args:
        path: of the file.
        error: what `require_content` raises.
        errors: what to do with bytes that are not UTF-8, as for `str.decode`.

    Raises:
        AscaError: as `require_content`.
        OSError: the file cannot be read.
        UnicodeDecodeError: it is not UTF-8.
    """
    require_content(path, error)
    return Path(path).read_text(encoding="utf-8-sig", errors=errors)
