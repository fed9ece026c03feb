"""Which files are scans, and under which name the results of each are written."""

import contextlib
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from asca_pillars.errors import ScanError
from asca_pillars.files import is_hidden

SCAN_SUFFIXES = (".bin", ".npy", ".pcd", ".ply", ".feather")
PREPARED_FILE = "README.txt"
PREPARED_NOTE = "Computed from the dataset by `asca prepare` or by a training run. Delete it when no run uses it.\n"
"""What the file says in a folder that is computed from a dataset: what lies there are no scans."""


class NamedScan(NamedTuple):
    """A scan file, and a relative path without a suffix that no other scan of the same run has."""

    path: Path
    name: Path


def find_scans(path: str | Path) -> list[Path]:
    """The scan at `path`, or those in the folder at `path`, to any depth, in natural order (2.bin before 10.bin).

    Hidden files and folders are left out, and what `asca prepare` computed; links to folders are followed.

    Raises:
        ScanError: there is no scan.
    """
    path = Path(path)
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise ScanError(f"{path}: no such file or folder; check the path")
    scans = [entry for entry in files_below(path) if is_scan(entry.relative_to(path)) and entry.is_file()]
    if not scans:
        raise ScanError(f"{path}: no scans in this folder; scans are {', '.join(SCAN_SUFFIXES)}")
    return sorted(scans, key=natural_order)


def files_below(folder: Path, above: frozenset[Path] = frozenset()) -> Iterator[Path]:
    """Every file below a folder, to any depth, in any order; links to folders are followed.

    Folders that may not be read are left out, those that `asca prepare` wrote, and links that lead to a folder which
    they are in (`above`).
    """
    here = above | {folder.resolve()}
    with contextlib.suppress(PermissionError):
        if _is_prepared(folder):
            return
        for entry in folder.iterdir():
            if not entry.is_dir():
                yield entry
            elif entry.resolve() not in here:
                yield from files_below(entry, here)


def visible_files(folder: Path, pattern: str) -> list[Path]:
    """The files in a folder whose names match, sorted; hidden ones are other programs', or left by a killed writer."""
    return sorted(path for path in folder.glob(pattern) if not is_hidden(Path(path.name)))


def _is_prepared(folder: Path) -> bool:
    path = folder / PREPARED_FILE
    return path.is_file() and path.read_text(encoding="utf-8", errors="replace") == PREPARED_NOTE


def name_scans(paths: Sequence[str | Path]) -> list[NamedScan]:
    """All scans at several paths, each once, with names for their results.

    A name is the scan's path below the folder that was given, without its suffix. Scans that would share a name are put
    below the name of the folder that was given (a/1.bin and b/1.bin), or keep their suffix (1.bin and 1.npy).

    Raises:
        ScanError: a path without scans, or two scans whose results would have the same name even then.
    """
    found: dict[Path, tuple[Path, Path]] = {}  # resolved path -> (scan, the folder that was given)
    for given in map(Path, paths):
        for scan in find_scans(given):
            found.setdefault(scan.resolve(), (scan, given.parent if given.is_file() else given))
    scans = [scan for scan, _ in found.values()]
    below = [scan.relative_to(root) for scan, root in found.values()]
    rooted = [root.resolve().name / name for (_, root), name in zip(found.values(), below, strict=True)]
    names = [name.with_suffix("") for name in below]
    for others in ([name.with_suffix("") for name in rooted], below, rooted):
        names = _where_shared(names, others)
    for name, count in Counter(names).items():
        if count > 1:
            first, second, *_ = (scan for scan, own in zip(scans, names, strict=True) if own == name)
            raise ScanError(f"{first} and {second}: their results would have one name, {name}; run them one by one")
    return [NamedScan(scan, name) for scan, name in zip(scans, names, strict=True)]


def _where_shared(names: Sequence[Path], others: Sequence[Path]) -> list[Path]:
    """`names`, and in the place of each one that occurs twice its `others`."""
    counts = Counter(names)
    return [other if counts[name] > 1 else name for name, other in zip(names, others, strict=True)]


def is_scan(relative: Path) -> bool:
    """Whether it is a scan by its name; `relative` to the folder that is searched."""
    if relative.suffix.lower() == ".feather" and not relative.stem.isdecimal():
        return False  # Argoverse 2 names sweeps by their time; its labels and poses are feather files too
    return relative.suffix.lower() in SCAN_SUFFIXES and not is_hidden(relative)


def natural_order(path: Path) -> list[list[tuple[int, str]]]:
    """A key by which 2.bin comes before 10.bin."""
    return [
        [(int(piece), "") if piece.isdecimal() else (-1, piece) for piece in re.split(r"(\d+)", part)]
        for part in path.parts
    ]
