"""Search for scan files, and unique names for their results."""

import hashlib
import os
import re
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import NamedTuple, TypeVar

from asca_pillars.base.errors import ScanError
from asca_pillars.base.files import is_hidden, require_content

SCAN_SUFFIXES = (".bin", ".npy", ".pcd", ".ply", ".las", ".laz", ".xyz", ".feather")
NAMED_SUFFIXES = (".csv", ".txt")
"""Files with these suffixes are read if they are given by name; in folders they are labels, calibrations and lists."""
PREPARED_FILE = "README.txt"
PREPARED_NOTE = "Computed from the dataset by `asca prepare` or by a training run. Delete it when no run uses it.\n"
"""Text of the file that marks a folder computed from a dataset, which contains no scans."""

_LONGEST_NAME_BYTES = 240
"""File names have at most 255 bytes, and results append suffixes such as `_image.png` to the name of their scan."""


Item = TypeVar("Item")


class NamedScan(NamedTuple):
    """Scan file, and a relative path without a suffix that is unique among the scans of a run."""

    path: Path
    name: Path


def evenly_spaced(items: Sequence[Item], most: int) -> list[Item]:
    """Return at most `most` of the items, evenly spaced, the first among them."""
    count = min(most, len(items))
    return [items[number * len(items) // count] for number in range(count)]


def find_scans(path: str | Path) -> list[Path]:
    """Return the scan at `path`, or all scans below the folder at `path`, in natural order (2.bin before 10.bin).

    Hidden files and folders and the output of `asca prepare` are left out; links to folders are followed. Entries with
    the name of a scan that are not regular files, and broken links, are refused when they are read.

    Raises:
        ScanError: there is no scan.
    """
    path = Path(path)
    require_content(path, ScanError)
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise ScanError(f"{path}: no such file or folder; check the path")
    scans = [entry for entry in files_below(path) if is_scan(entry.relative_to(path))]
    if not scans:
        raise ScanError(
            f"{path}: no scans in this folder; scans are {', '.join(SCAN_SUFFIXES)}; "
            f"give {' and '.join(NAMED_SUFFIXES)} files by name"
        )
    return sorted(scans, key=natural_order)


def files_below(folder: Path) -> Iterator[Path]:
    """Yield every file below a folder; links to folders are followed.

    Each folder is visited once, under the path without a link on it if there is one. Folders that may not be read are
    left out, and those that `asca prepare` wrote.
    """
    visited: set[tuple[int, int]] = set()
    folders, links = [folder], deque[Path]()
    while folders or links:
        current = folders.pop() if folders else links.popleft()
        try:
            if (identity := _folder_identity(current)) in visited or _is_prepared(current):
                continue
            visited.add(identity)
            entries = sorted(os.scandir(current), key=lambda entry: entry.name)
        except OSError:
            continue
        for entry in entries:
            if not _is_folder(entry):
                yield current / entry.name
            else:
                (links if entry.is_symlink() else folders).append(current / entry.name)


def _folder_identity(folder: Path) -> tuple[int, int]:
    """Return the device and inode of a folder, equal on all paths to it; resolving a path takes milliseconds."""
    status = folder.stat()
    return status.st_dev, status.st_ino


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # circular links
        return False


def visible_files(folder: Path, pattern: str) -> list[Path]:
    """Return the visible files of a folder whose names match, sorted; hidden ones are temporary or of others."""
    return sorted(path for path in folder.glob(pattern) if not is_hidden(Path(path.name)))


def _is_prepared(folder: Path) -> bool:
    path = folder / PREPARED_FILE
    return (
        path.is_file()
        and path.stat().st_size < 2 * len(PREPARED_NOTE)
        and path.read_text(encoding="utf-8", errors="replace") == PREPARED_NOTE
    )


def name_scans(paths: Sequence[str | Path]) -> list[NamedScan]:
    """Return all scans at several paths, each once, with names for their results.

    A name is the scan's path below the folder that was given, without its suffix. Scans that would share a name are put
    below the name of the folder that was given (a/1.bin and b/1.bin), or keep their suffix (1.bin and 1.npy). Of a name
    that is too long for files of results the end gives way to a part of its SHA-256.

    Raises:
        ScanError: a path without scans, or two scans whose results would have the same name even then.
    """
    origins: dict[tuple[tuple[int, int], str], tuple[Path, Path]] = {}  # (its folder, name) -> (scan, given path)
    folder_identity, resolved = cache(_folder_identity), cache(Path.resolve)
    for given in map(Path, paths):
        for scan in find_scans(given):
            place = scan.resolve() if scan.is_symlink() and scan.exists() else scan
            key = folder_identity(place.parent), place.name
            origins.setdefault(key, (scan, given.parent if given.is_file() else given))
    scans = [scan for scan, _ in origins.values()]
    below = [scan.relative_to(root) for scan, root in origins.values()]
    rooted = [resolved(root).name / name for (_, root), name in zip(origins.values(), below, strict=True)]
    names = [name.with_suffix("") for name in below]
    for others in ([name.with_suffix("") for name in rooted], below, rooted):
        names = _where_shared(names, others)
    names = [_shortened(name) for name in names]
    for name, count in Counter(names).items():
        if count > 1:
            first, second, *_ = (scan for scan, other in zip(scans, names, strict=True) if other == name)
            raise ScanError(f"{first} and {second}: their results would have one name, {name}; run them one by one")
    return [NamedScan(scan, name) for scan, name in zip(scans, names, strict=True)]


def _where_shared(names: Sequence[Path], others: Sequence[Path]) -> list[Path]:
    """Return `names`, with each one that occurs twice replaced by its entry in `others`."""
    counts = Counter(names)
    return [other if counts[name] > 1 else name for name, other in zip(names, others, strict=True)]


def _shortened(name: Path) -> Path:
    """Return the name, or if its last part is too long its start and eight digits of its SHA-256."""
    encoded = os.fsencode(name.name)
    if len(encoded) <= _LONGEST_NAME_BYTES:
        return name
    digest = hashlib.sha256(encoded).hexdigest()[:8]
    return name.with_name(f"{encoded[: _LONGEST_NAME_BYTES - 9].decode(errors='ignore')}-{digest}")


def is_scan(relative: Path) -> bool:
    """Return whether a file is a scan by its name; `relative` to the folder that is searched."""
    if relative.suffix.lower() == ".feather" and not relative.stem.isdecimal():
        return False  # Argoverse 2 names sweeps by their time; its labels and poses are feather files too
    return relative.suffix.lower() in SCAN_SUFFIXES and not is_hidden(relative)


def natural_order(path: Path) -> list[list[tuple[int, str]]]:
    """Return a sort key by which 2.bin precedes 10.bin."""
    return [_pieces(part) for part in path.parts]


@lru_cache(maxsize=4096)  # folders are parts of many paths
def _pieces(part: str) -> list[tuple[int, str]]:
    return [(int(piece), "") if piece.isdecimal() else (-1, piece) for piece in re.split(r"(\d+)", part)]
