"""Locks of files and folders, which end with the process that holds them, and what killed writers leave behind.

What is being written has a name of its own beside its target, `.NAME.asca-12345678.SUFFIX`, and is locked (`flock`)
while its writer lives. That tells what a killed writer left from what another process writes just now.
"""

import contextlib
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

from asca_pillars.base.errors import OutputError

try:
    import fcntl
except ImportError:  # Windows: nothing is locked
    fcntl = None  # type: ignore[assignment]

CAN_LOCK = fcntl is not None
RETIRED = "-old"
"""Ends the temporary name of a folder that was moved aside and not yet replaced."""
_TEMPORARY = re.compile(rf"\.(?P<name>.+)\.asca-[0-9a-f]{{8}}(?P<retired>{RETIRED})?(?:\.[^.]*)?")


def is_temporary(name: str) -> bool:
    """Return whether a file or folder has a temporary name instead of a final one."""
    return _TEMPORARY.fullmatch(name) is not None


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
    try:
        with contextlib.ExitStack() as stack:
            if fcntl is not None:
                handle = os.open(folder, os.O_RDONLY)
                stack.callback(os.close, handle)
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except (BlockingIOError, PermissionError):
                    raise OutputError(
                        f"{folder}: another `{command}` is at work there; let it end, or choose another folder"
                    ) from None
                except OSError:  # a file system without locks
                    pass
            yield
    finally:
        with contextlib.suppress(OSError):  # it is not empty
            folder.rmdir()


def recover(folder: str | Path) -> None:
    """Remove what killed writers left in `folder`; put back a folder that one had moved aside and not replaced.

    What a living process writes just now is left alone, and so is everything that has not our temporary names. A
    command calls it before it writes; a process that shares the folder with other machines must not, for it may not
    see their locks.
    """
    folder = Path(folder)
    if not CAN_LOCK or not folder.is_dir():
        return
    for path in sorted(folder.glob(".*.asca-*")):
        match = _TEMPORARY.fullmatch(path.name)
        if match is None or path.is_symlink():
            continue
        with contextlib.suppress(OSError), locked(path, wait=False):
            if not path.is_dir():
                path.unlink()
            elif match["retired"] and not (folder / match["name"]).exists():
                path.replace(folder / match["name"])
            else:
                shutil.rmtree(path)
