"""Writing files so that a crash, a kill or a loss of power never leaves half of one under its final name.

What is being written has a name of its own beside its target, `.NAME.asca-12345678.SUFFIX`, and is locked (`flock`)
while its writer lives. What a killed writer left is therefore told from what another process writes just now, and the
next process that writes into the same folder removes it.
"""

import contextlib
import ctypes
import errno
import json
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from asca_pillars.errors import OutputError
from asca_pillars.locks import CAN_LOCK, locked

_TEMPORARY = re.compile(r"\.(?P<name>.+)\.asca-[0-9a-f]{8}(?P<retired>-old)?(?:\.[^.]*)?")
_LONGEST_NAME_BYTES = 255  # of a file, on nearly every file system
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
_cleared: set[Path] = set()  # folders whose leftovers this process has looked for
_shares_folders = False


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` that is renamed over it if the block succeeds, and removed if not.

    The temporary name keeps the suffix of `path`, because several writers choose their format by it. A link at `path`
    stays one: the file that it leads to is replaced.

    Raises:
        OutputError: a folder or a device is at `path`.
        OSError: names `path`, even where the system's own error names no file (a full disk).
    """
    target = _prepare(path)
    if target.exists() and not target.is_file():
        raise OutputError(f"{path}: is {'a folder' if target.is_dir() else 'no regular file'}; choose a file's name")
    stem = os.fsencode(target.stem)[: _LONGEST_NAME_BYTES - len(".12345678.asca-") - len(os.fsencode(target.suffix))]
    prefix = f".{stem.decode(errors='ignore')}.asca-"
    with _naming(path), _temporary(target, prefix, target.suffix, folder=False) as temporary:
        yield temporary
        _sync(temporary)
        temporary.replace(target)
        _sync(target.parent)


@contextlib.contextmanager
def atomic_directory(path: str | Path, command: str, marker: str) -> Iterator[Path]:
    """Yield a temporary folder beside `path` that takes its place if the block succeeds, and is removed if not.

    The block has to write `marker`, which names all other files of the folder. An existing folder at `path` stays whole
    until the new one is complete, and the two change places in one step where the system can do that (Linux). Elsewhere
    a kill between two renames leaves nothing at `path`; the next `recover` of the parent folder, which every write into
    it starts with, puts the old folder back.

    Raises:
        OutputError: as `require_replaceable`.
        OSError: names `path`, even where the system's own error names no file.
    """
    target = _prepare(path)
    require_replaceable(target, command, marker)
    with _naming(path), _temporary(target, f".{target.name}.asca-", "", folder=True) as temporary:
        yield temporary
        for folder, _, names in os.walk(temporary, topdown=False):
            for name in names:
                _sync(Path(folder, name))
            _sync(Path(folder))
        require_replaceable(target, command, marker)
        if not target.exists():
            temporary.replace(target)
        elif not _exchange(temporary, target):
            _replace_in_two_steps(temporary, target)
        _sync(target.parent)


def remove_directory(path: str | Path, command: str, marker: str) -> None:
    """Remove the folder that `atomic_directory` wrote at `path`, as a whole; leave anything without `marker` alone.

    Raises:
        OutputError: as `require_replaceable`.
    """
    target = Path(os.path.realpath(path))
    require_replaceable(target, command, marker)
    if (target / marker).is_file():
        with _temporary(target, f".{target.name}.asca-", "", folder=True) as temporary:
            target.replace(temporary / target.name)


def write_json(path: str | Path, content: Any) -> None:
    """Write plain values as JSON, through `atomic_path`.

    Raises:
        ValueError: a number is NaN or infinite; JSON has no such thing.
    """
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def require_replaceable(folder: str | Path, command: str, marker: str) -> None:
    """Make sure that nothing is lost if `command` replaces `folder` as a whole.

    It may be absent, empty, or hold an earlier output of the same command: the file `marker` and files that are named
    in its text, nothing else.

    Raises:
        OutputError: a file is there, or the folder holds something else; names it.
    """
    folder = Path(folder)
    if not _entries(folder):
        return
    if not (folder / marker).is_file():
        raise OutputError(
            f"{folder}: holds {_entries(folder)[0].name} and no {marker}, so `{command}` did not write it; "
            "choose another folder, or empty this one"
        )
    named = set(re.split(r"[\s\"'`()\[\]|,:]+", (folder / marker).read_text(encoding="utf-8", errors="replace")))
    for entry in _entries(folder):
        if entry.name != marker and not (entry.name in named and entry.is_file()):
            raise OutputError(
                f"{entry}: `{command}` did not write it and would delete it with the folder; move it elsewhere, "
                "or choose another folder"
            )


def require_own(folder: str | Path, command: str, *markers: str, text: str = "") -> None:
    """Make sure that `command` may write into `folder`: it is absent, empty, or holds one of the files `markers`.

    Args:
        folder: to be written into; what is in it and has other names stays.
        command: for the message.
        markers: files that the command writes, by their paths in the folder.
        text: what a marker has to contain to be the command's own.

    Raises:
        OutputError: a file is there, or a folder of other files.
    """
    folder = Path(folder)
    recover(folder.parent)
    entries = _entries(folder)
    for marker in markers:
        path = folder / marker
        if path.is_file():
            content = path.read_text(encoding="utf-8", errors="replace")
            if text in content or not content:  # nothing was written yet, and nothing can be lost
                return
    if entries:
        raise OutputError(
            f"{folder}: holds {entries[0].name} and nothing that `{command}` wrote; choose another folder, or empty it"
        )


def share_folders() -> None:
    """Let this process take nothing for a leftover: other machines write to its folders, too.

    Not every network mount shows one machine the locks of another.
    """
    global _shares_folders
    _shares_folders = True


def recover(folder: str | Path, *, again: bool = False) -> None:
    """Remove what killed writers left in `folder`; put back what one had moved aside and not replaced.

    Once a process, unless `again`. What a living process writes just now is left alone, and so is everything that has
    not our temporary names.
    """
    folder = Path(os.path.realpath(folder))
    if _shares_folders or (folder in _cleared and not again) or not CAN_LOCK or not folder.is_dir():
        return
    _cleared.add(folder)
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


def is_hidden(relative: Path) -> bool:
    """Whether it or a folder on the way to it is; `relative` to the folder that is searched."""
    return any(part.startswith(".") for part in relative.parts)


def _prepare(path: str | Path) -> Path:
    """The place that `path` leads to, in a folder that exists and holds nothing of killed writers."""
    target = Path(os.path.realpath(path))
    _make_folder(target.parent)
    recover(target.parent)
    return target


def _make_folder(folder: Path) -> None:
    """Create a folder and those above it; `mkdir(parents=True)` calls itself for each and fails at a thousand."""
    missing = [folder]
    while not missing[-1].exists():
        missing.append(missing[-1].parent)
    for one in reversed(missing):
        one.mkdir(exist_ok=True)


def _entries(folder: Path) -> list[Path]:
    """What is in a folder, without what is being written just now; nothing if there is no folder."""
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file where a folder is to be written; choose another name")
    return sorted(path for path in folder.glob("*") if not _TEMPORARY.fullmatch(path.name)) if folder.exists() else []


@contextlib.contextmanager
def _temporary(target: Path, prefix: str, suffix: str, *, folder: bool) -> Iterator[Path]:
    """A new file or folder beside `target`, locked; removed at the end if it is still there."""
    while True:
        temporary = target.with_name(f"{prefix}{secrets.token_hex(4)}{suffix}")
        # The kernel applies the umask: reading it from here would change it for all threads.
        if folder:
            temporary.mkdir()
        else:
            os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        with contextlib.ExitStack() as stack:
            with contextlib.suppress(FileNotFoundError):  # taken for a leftover before it was locked
                stack.enter_context(locked(temporary))
            if not temporary.exists():
                continue
            try:
                yield temporary
            finally:
                # After an exchange this is the old folder.
                shutil.rmtree(temporary, ignore_errors=True) if folder else temporary.unlink(missing_ok=True)
            return


@contextlib.contextmanager
def _naming(path: str | Path) -> Iterator[None]:
    """Give the name of `path` to an error of the system that names no file, as of a full disk, or the temporary one."""
    try:
        yield
    except OSError as error:
        named = error.filename is not None and not _TEMPORARY.fullmatch(Path(str(error.filename)).name)
        if named or isinstance(error, OutputError):
            raise
        raise OSError(error.errno or errno.EIO, error.strerror or str(error), str(path)) from error


def _sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk and not only in memory."""
    if path.is_dir() and not CAN_LOCK:
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _exchange(one: Path, other: Path) -> bool:
    """Let two folders change names in one step; False where the system or the file system cannot."""
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None) if os.name == "posix" else None
    if rename is None:
        return False
    if rename(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), ctypes.c_uint(_RENAME_EXCHANGE)) == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP):
        return False
    raise OSError(code, os.strerror(code), str(other))


def _replace_in_two_steps(temporary: Path, target: Path) -> None:
    retired = temporary.with_name(f"{temporary.name}-old")
    with locked(target):
        target.replace(retired)
        try:
            temporary.replace(target)
        except OSError:
            retired.replace(target)
            raise
    shutil.rmtree(retired, ignore_errors=True)
