"""The rule for what a command may replace, for every file and folder that `asca` writes.

- What exists under a name that is to be written is replaced only if its content shows that the same command wrote it.
  An empty file may be replaced, for nothing is lost. Anything else is refused before the work: the user moves it away,
  or chooses another name.
- It is never one of the command's own inputs.
- It is never reached through a link: a link in its place is refused, and so is one among the folders on the way to it
  below the folder that the user gave, which may be a link itself.

Every kind of file has a recognizer that looks at the content. `files` writes beside the final name and renames.
"""

import json
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

from asca_pillars.base.errors import OutputError
from asca_pillars.base.locks import is_temporary, recover

Recognizer: TypeAlias = Callable[[Path], bool]
"""A function that tells by its content whether an existing file is one that the command writes under that name."""

PICTURE_SOFTWARE = "asca-pillars"
"""Value of the text field Software in every PNG that we write."""
_LARGEST_JSON_BYTES = 64 << 20


def json_object(*keys: str, **values: Any) -> Recognizer:
    """Recognize a JSON object that has all of these keys, and these values."""

    def recognize(path: Path) -> bool:
        with path.open("rb") as file:
            return _has(file.read(_LARGEST_JSON_BYTES), keys, values)

    return recognize


def json_lines(*keys: str) -> Recognizer:
    """Recognize lines of JSON by the first of them, an object that has all of these keys; there may be no line yet."""

    def recognize(path: Path) -> bool:
        with path.open("rb") as file:
            line = file.readline(_LARGEST_JSON_BYTES)
        return not line or _has(line, keys, {})

    return recognize


def starting_with(text: str) -> Recognizer:
    """Recognize a text by its beginning."""

    def recognize(path: Path) -> bool:
        with path.open("rb") as file:
            return file.read(len(text.encode())) == text.encode()

    return recognize


def ending_with(text: str) -> Recognizer:
    """Recognize a text by its end."""

    def recognize(path: Path) -> bool:
        end = text.encode()
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - len(end)))
            return file.read() == end

    return recognize


def written_by(command: str) -> str:
    """Return the sentence by which `command` recognizes a text that it wrote."""
    return f"Written by `{command}`, which may replace it."


def page_end(command: str) -> str:
    """Return the last lines of a Markdown page that `command` writes: the sentence, which is not shown to readers."""
    return f"\n<!-- {written_by(command)} -->\n"


def is_own_picture(path: Path) -> bool:
    """Return whether it is a PNG that we wrote, by its text field Software."""
    with path.open("rb") as file:
        head = file.read(512)
    return head.startswith(b"\x89PNG") and b"tEXtSoftware\0" + PICTURE_SOFTWARE.encode() in head


def require_own_file(
    path: str | Path, command: str, is_own: Recognizer, inputs: Iterable[str | Path | None] = ()
) -> None:
    """Make sure that `command` may write the file `path`: it is absent, empty, or what `command` wrote there before.

    Args:
        path: the file.
        command: for the message.
        is_own: recognizes it.
        inputs: that the command reads; None means no input.

    Raises:
        OutputError: something else is there, a link, or an input.
        OSError: it cannot be read.
    """
    path = Path(path)
    require_no_link(path)
    if not path.exists():
        return
    require_regular_file(path)
    require_not_input(path, inputs)
    if path.stat().st_size and not is_own(path):
        raise OutputError(
            f"{path}: `{command}` did not write it and would replace it; choose another place, or move it away"
        )


def require_regular_file(path: Path) -> None:
    """Raise OutputError unless an existing path is a regular file."""
    if not path.is_file():
        raise OutputError(
            f"{path}: is {'a folder' if path.is_dir() else 'not a regular file'}; choose the name of a file"
        )


def require_own(
    folder: str | Path,
    command: str,
    products: Mapping[str, Recognizer],
    *,
    folders: Iterable[str | Path] = (),
) -> None:
    """Make sure that `command` may write into `folder`: it is absent, empty, or one that the command wrote into.

    Args:
        folder: to be written into; it may be a link to a folder. What is in it and has other names stays.
        command: for the message.
        products: recognizers of the files that the command writes there, by their paths in the folder. One of them
            marks the folder as the command's, and none may be of somebody else.
        folders: below it, that the command writes into.

    Raises:
        OutputError: a file is there, a folder of other files, or a link or a foreign file where a product belongs.
        OSError: a file cannot be read.
    """
    folder = Path(folder)
    entries = _entries(folder)
    for below in folders:
        require_no_link(folder, below)
        recover(folder / below)
    recover(folder)
    for name in products:
        require_no_link(folder, name)
    if entries and not any((folder / name).is_file() and is_own(folder / name) for name, is_own in products.items()):
        raise OutputError(
            f"{folder}: holds {entries[0].name} and nothing that `{command}` wrote; choose another folder, or empty it"
        )
    for name, is_own in products.items():
        require_own_file(folder / name, command, is_own)


def require_replaceable(folder: str | Path, command: str, marker: str, is_own: Recognizer) -> None:
    """Make sure that nothing is lost if `command` replaces `folder` as a whole.

    It may be absent, empty, or hold an earlier output of the same command: the file `marker` and files that are named
    in its text, nothing else.

    Raises:
        OutputError: a file or a link is there, or the folder holds something else; names it.
    """
    folder = Path(folder)
    require_no_link(folder)
    recover(folder.parent)
    entries = _entries(folder)
    if not entries:
        return
    path = folder / marker
    if not path.is_file():
        raise OutputError(
            f"{folder}: holds {entries[0].name} and no {marker}, so `{command}` did not write it; "
            "choose another folder, or empty this one"
        )
    require_own_file(path, command, is_own)
    named = set(re.split(r"[\s\"'`()\[\]|,:]+", path.read_text(encoding="utf-8", errors="replace")))
    for entry in entries:
        require_no_link(entry)
        if entry.name != marker and not (entry.name in named and entry.is_file()):
            raise OutputError(
                f"{entry}: `{command}` did not write it and would delete it with the folder; move it elsewhere, "
                "or choose another folder"
            )


def require_no_link(path: str | Path, below: str | Path | None = None) -> None:
    """Refuse a link at `path`, or, with `below`, at any step of that relative path below `path`.

    Raises:
        OutputError: names the link.
    """
    parts = () if below is None else Path(below).parts
    steps = [Path(path)] if below is None else [Path(path, *parts[: count + 1]) for count in range(len(parts))]
    for step in steps:
        if step.is_symlink():
            raise OutputError(
                f"{step}: is a link, and nothing is written through links; remove it, or choose another place"
            )


def require_not_input(target: str | Path, inputs: Iterable[str | Path | None]) -> None:
    """Refuse a target that is one of the inputs, or a folder with one of them in it; None means no input.

    Raises:
        OutputError: names the input.
    """
    for given in inputs:
        if given is None or not Path(given).exists():  # the name of something that ships
            continue
        read = Path(given).resolve()
        if Path(target).resolve() in (read, *read.parents):
            raise OutputError(f"{target}: would replace the input {given}; write to another place")


def _has(content: bytes, keys: Iterable[str], values: Mapping[str, Any]) -> bool:
    try:
        record = json.loads(content)
    except (ValueError, RecursionError):  # not JSON, not UTF-8, or nested too deeply
        return False
    if not isinstance(record, dict):
        return False
    return all(key in record for key in keys) and all(record.get(key) == value for key, value in values.items())


def _entries(folder: Path) -> list[Path]:
    """List what is in a folder, without what is being written just now; nothing if there is no folder."""
    if folder.is_symlink() and not folder.exists():
        raise OutputError(f"{folder}: is a broken link; create the folder that it points to, or choose another one")
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file where a folder is to be written; choose another name")
    return sorted(path for path in folder.glob("*") if not is_temporary(path.name)) if folder.exists() else []
