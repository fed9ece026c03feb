"""Writing of files so that a crash never leaves half of one under its final name, and checks before they are read.

What is being written has a name of its own beside its target (`locks`), and gets the final name when it is complete and
on the disk. What a command may replace is in `base.own_files`.
"""

import contextlib
import errno
import hashlib
import json
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Literal

from asca_pillars.base.errors import AscaError, ConfigError
from asca_pillars.base.locks import CAN_LOCK, RETIRED, is_temporary, locked, recover
from asca_pillars.base.own_files import (
    Recognizer,
    require_no_link,
    require_own_file,
    require_regular_file,
    require_replaceable,
)

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
            raise error(f"{path}: is {name}, not a regular file; copy its content to a file and give that")
    if stat.S_ISREG(status.st_mode) and status.st_size <= _LARGEST_POINTER_BYTES:
        with Path(path).open("rb") as file:
            if file.read(len(_LFS_POINTER)) == _LFS_POINTER:
                raise error(f"{path}: is a Git LFS pointer whose content was not fetched; run `git lfs pull`")


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


WEIGHTS_FILE: Literal["weights.ckpt"] = "weights.ckpt"
"""Trained weights alone, among the checkpoints of a run and in a bundle."""
_LONGEST_NAME_BYTES = 255  # limit of nearly every file system
_NOT_PLAIN = re.compile(r"[^A-Za-z0-9._-]")
_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\.|$)", re.IGNORECASE)  # devices of Windows
_LONGEST_NAME = 100  # characters; systems allow 255 bytes, suffixes and the names of temporary files included


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` that is renamed over it if the block succeeds, and removed if not.

    The temporary name keeps the suffix of `path`, because several writers choose their format by it.

    Raises:
        OutputError: a folder, a device or a link is at `path`.
        OSError: names `path`, even where the system's own error names no file (a full disk).
    """
    target = _prepare(path)
    if target.exists():
        require_regular_file(Path(path))
    longest = _LONGEST_NAME_BYTES - len(".12345678.asca-") - len(os.fsencode(target.suffix))
    stem = os.fsencode(target.stem)[:longest].decode(errors="ignore")
    with _with_path_in_errors(path), _temporary(target, stem, target.suffix, folder=False) as temporary:
        yield temporary
        _sync(temporary)
        temporary.replace(target)
        _sync(target.parent)


@contextlib.contextmanager
def atomic_directory(path: str | Path, command: str, marker: str, is_own: Recognizer) -> Iterator[Path]:
    """Yield a temporary folder beside `path` that takes its place if the block succeeds, and is removed if not.

    The block has to write `marker`, which names all other files of the folder. An existing folder at `path` stays whole
    until the new one is complete. A kill between the two renames then leaves nothing at `path`, and `locks.recover` of
    the parent folder, which `require_replaceable` begins with, puts the old folder back.

    Raises:
        OutputError: as `require_replaceable`.
        OSError: names `path`, even where the system's own error names no file.
    """
    target = _prepare(path)
    require_replaceable(target, command, marker, is_own)
    with _with_path_in_errors(path), _temporary(target, target.name, "", folder=True) as temporary:
        yield temporary
        for folder, _, names in os.walk(temporary, topdown=False):
            for name in names:
                _sync(Path(folder, name))
            _sync(Path(folder))
        require_replaceable(target, command, marker, is_own)
        if target.exists():
            _replace_folder(temporary, target)
        else:
            temporary.replace(target)
        _sync(target.parent)


def remove_directory(path: str | Path, command: str, marker: str, is_own: Recognizer) -> None:
    """Remove the folder that `atomic_directory` wrote at `path`, as a whole; leave an empty one alone.

    Raises:
        OutputError: as `require_replaceable`.
    """
    require_replaceable(path, command, marker, is_own)
    target = Path(os.path.realpath(path))
    if (target / marker).is_file():
        with _temporary(target, target.name, "", folder=True) as temporary:
            target.replace(temporary / target.name)


def write_json(path: str | Path, content: Any) -> None:
    """Write plain values as JSON, through `atomic_path`.

    Raises:
        ValueError: a number is NaN or infinite; JSON has no such thing.
    """
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def write_text(path: str | Path, text: str) -> None:
    """Write a text as UTF-8 with the same bytes on every system, through `atomic_path`."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def portable_name(text: str) -> str:
    """Return the name of one file for a text that comes from data: itself if it is a plain name on every system.

    Anything but ASCII letters, digits, dot, dash and underscore becomes an underscore. What had to be changed gets a
    digest of the text, so that different texts keep different names.
    """
    plain = _NOT_PLAIN.sub("_", text)
    usual = text[:1] not in (".", "-", "") and text[-1:] != "." and not _RESERVED.match(text)
    if plain == text and usual and len(text) <= _LONGEST_NAME:
        return text
    digest = hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:8]
    return f"_{plain.strip('._-')[: _LONGEST_NAME - 10]}-{digest}"


def file_inside(folder: Path, name: str) -> Path | None:
    """Return the file below `folder` that a name from data stands for; None if there is none, or it leads outside.

    Links in the folder are followed.
    """
    relative = Path(name)
    if relative.is_absolute() or relative.drive or ".." in relative.parts:
        return None
    try:
        return folder / relative if (folder / relative).is_file() else None
    except (OSError, ValueError):  # too long, or characters that no name has
        return None


def is_hidden(relative: Path) -> bool:
    """Return whether a path or one of its folders is hidden; `relative` to the folder that is searched."""
    return any(part.startswith(".") for part in relative.parts)


def _prepare(path: str | Path) -> Path:
    """Return the place that `path` leads to, itself no link, in a folder that is made if it is missing."""
    require_no_link(path)
    target = Path(os.path.realpath(path))
    _make_folder(target.parent)
    return target


def _make_folder(folder: Path) -> None:
    """Create a folder and those above it; `mkdir(parents=True)` calls itself for each and fails at a thousand."""
    missing = [folder]
    while not missing[-1].exists():
        missing.append(missing[-1].parent)
    for ancestor in reversed(missing):
        ancestor.mkdir(exist_ok=True)


@contextlib.contextmanager
def _temporary(target: Path, stem: str, suffix: str, *, folder: bool) -> Iterator[Path]:
    """Yield a new, locked file or folder beside `target`; it is removed at the end if it is still there."""
    while True:
        temporary = target.with_name(f".{stem}.asca-{secrets.token_hex(4)}{suffix}")
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
                shutil.rmtree(temporary, ignore_errors=True) if folder else temporary.unlink(missing_ok=True)
            return


def _replace_folder(temporary: Path, target: Path) -> None:
    """Move the old folder aside, the new one into its place, and remove the old one."""
    retired = temporary.with_name(f"{temporary.name}{RETIRED}")
    with locked(target):
        target.replace(retired)
        try:
            temporary.replace(target)
        except OSError:
            retired.replace(target)
            raise
    shutil.rmtree(retired, ignore_errors=True)


@contextlib.contextmanager
def _with_path_in_errors(path: str | Path) -> Iterator[None]:
    """Give the name of `path` to an error of the system that names no file, as of a full disk, or the temporary one."""
    try:
        yield
    except OSError as error:
        if error.filename is not None and not is_temporary(Path(str(error.filename)).name):
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


_DIGITS = 16
_BEFORE = len('["", ') + _DIGITS


def add_checksum(text: str, key: str) -> str:
    """Return the line of a JSON text that has no line break, with its end."""
    return f'["{_digest(text, key)}", {text}]\n'


def verify_checksum(line: bytes, key: str) -> str | None:
    """Return the JSON text of a line that `add_checksum` made with the same key; None for anything else."""
    try:
        text = line[_BEFORE:-2].decode()
    except UnicodeDecodeError:
        return None
    return text if line == add_checksum(text, key).encode() else None


def _digest(text: str, key: str) -> str:
    return hashlib.sha256(f"{key}\n{text}".encode()).hexdigest()[:_DIGITS]


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
