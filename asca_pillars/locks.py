"""Locks of files and folders, which end with the process that holds them, however it ends."""

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

from asca_pillars.errors import OutputError

try:
    import fcntl
except ImportError:  # Windows: nothing is locked
    fcntl = None  # type: ignore[assignment]

CAN_LOCK = fcntl is not None


def try_lock(handle: int) -> bool:
    """Lock an open file for this process until it closes it; False if another process holds it."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES)  # others: no locks there
    return True


@contextlib.contextmanager
def locked(path: Path, *, wait: bool = True) -> Iterator[None]:
    """Hold the lock of a file or folder.

    Raises:
        OSError: another process holds it and `wait` is False, or there is nothing at `path`.
    """
    if fcntl is None:
        yield
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        with contextlib.suppress(*((OSError,) if wait else ())):  # a file system without locks
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        yield
    finally:
        os.close(handle)


@contextlib.contextmanager
def only_writer(folder: str | Path, command: str) -> Iterator[None]:
    """Make `folder` where it is missing, and hold it: a second `only_writer` of it is refused until the block ends.

    If nothing was written there, it is removed again. Where there are no locks (Windows, some network mounts), nobody
    is refused. A process that is killed holds nothing any more.

    Raises:
        OutputError: another process holds it.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    handle = None if fcntl is None else os.open(folder, os.O_RDONLY)
    try:
        if handle is not None and not try_lock(handle):
            raise OutputError(f"{folder}: another `{command}` is at work there; let it end, or choose another folder")
        yield
    finally:
        if handle is not None:
            os.close(handle)
        with contextlib.suppress(OSError):  # it is not empty
            folder.rmdir()
