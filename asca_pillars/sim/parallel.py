"""Simulation of frames in several processes, into a folder that records its settings."""

import json
import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from asca_pillars.base.errors import ConfigError, DatasetError
from asca_pillars.base.files import write_text
from asca_pillars.base.own_files import json_object, require_no_link, require_own, require_own_file
from asca_pillars.base.processes import map_in_processes
from asca_pillars.base.progress import Reporter
from asca_pillars.data.kitti.kitti_split import SIMULATION_FILE

COMMAND = "asca simulate"
Item = TypeVar("Item")


def check_counts(counts: dict[str, int], val_share: float) -> None:
    """Raise ConfigError for a count below 1 or a share outside 0..1."""
    for name, count in counts.items():
        if count < 1:
            raise ConfigError(f"{name} is {count}; it must be at least 1")
    if not 0.0 <= val_share <= 1.0:
        raise ConfigError(f"val_share is {val_share}; it must lie between 0 and 1")


def held_out(count: int, share: float) -> int:
    """Return the number of frames or sequences for validation: at least one, if one remains for training."""
    rounded = round(count * share)
    return min(max(rounded, 1), count - 1) if 0 < share < 1 and count > 1 else rounded


def for_each(job: Callable[[Item], None], todo: Sequence[Item], workers: int, reporter: Reporter) -> None:
    """Do a job for each item, in `workers` processes; the job must be picklable."""
    for _ in map_in_processes(job, todo, workers, "Simulating", reporter=reporter):
        pass


def require_own_simulation(root: Path, about_keys: Sequence[str], folders: Iterable[str | Path]) -> None:
    """Make sure that `asca simulate` may write into `root`: it is absent, empty, or holds an earlier simulation.

    Args:
        root: the folder.
        about_keys: keys of its simulation.json.
        folders: folders below `root` for the frames.

    Raises:
        OutputError: something else is there, such as a list that was edited, or a link.
    """
    require_own(root, COMMAND, {SIMULATION_FILE: json_object(*about_keys)}, folders=("ImageSets", *folders))
    for name in ("train", "val"):
        require_own_file(root / "ImageSets" / f"{name}.txt", COMMAND, _names_successive_frames)


def write_once(path: Path, write: Callable[[Path], None]) -> None:
    """Write a file of a frame with `write`. One with the same bytes, of a run that was killed, stays.

    Raises:
        OutputError: a file of other bytes is there.
    """
    require_no_link(path)
    if not path.exists() or not path.stat().st_size:
        write(path)
        return
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / path.name)
        require_own_file(path, COMMAND, lambda existing: existing.read_bytes() == Path(folder, path.name).read_bytes())


def record_settings(root: Path, about: dict[str, Any], scans: Path) -> None:
    """Write the settings of the frames of a folder to simulation.json, or refuse a folder of other frames.

    Args:
        root: the folder.
        about: the settings, plain values.
        scans: folder below it that holds the scans.

    Raises:
        DatasetError: the scans there have other settings.
    """
    path = root / SIMULATION_FILE
    text = json.dumps(about, indent=2) + "\n"
    if not path.exists():
        if any(scans.rglob("*.bin")):
            raise DatasetError(f"{scans}: holds scans that were not simulated; choose another folder")
        write_text(path, text)
    elif path.read_text(encoding="utf-8") != text:
        raise DatasetError(f"{path}: the frames there have another seed or configuration; choose another folder")


def _names_successive_frames(path: Path) -> bool:
    """Return whether a list is one that is written here, of frames (000007) or of sequences (0002/000031)."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        rows = [[int(part) for part in line.split("/")] for line in lines]
    except ValueError:
        return False
    length = 1 + max(sum(row[1:]) for row in rows)
    numbers = [row[0] * length + sum(row[1:]) for row in rows]
    return numbers == list(range(numbers[0], numbers[0] + len(numbers)))
