"""Work cut into shards, and the files in which the results of each appear at once or not at all.

    run.json                         what the results depend on
    000000256-1f3a9c04d2b7.jsonl     a line for each item of a shard, the first of which is number 256

A shard's name is made of the number of its first item and of a digest of its items. A file that is there is therefore
the result of these items and no others, also where the list of items has changed since. Each line has a digest
(`base.sealed_lines`), and there are as many as items: a file that was cut or damaged is no result.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from asca_pillars.base.errors import OutputError
from asca_pillars.base.files import atomic_path, write_json
from asca_pillars.base.sealed_lines import sealed, unsealed

RUN_SETTINGS = "run.json"
_SUFFIX = ".jsonl"


class Shard(NamedTuple):
    """Successive items of a run: the number of the first one, and the items, plain values that JSON can hold."""

    first: int
    items: tuple[Any, ...]

    @property
    def name(self) -> str:
        """Different for other items."""
        return f"{self.first:09d}-{hashlib.sha256(json.dumps(self.items).encode()).hexdigest()[:12]}"

    @property
    def halves(self) -> tuple["Shard", "Shard"]:
        """Two shards of these items, of which there must be two at least."""
        middle = len(self.items) // 2
        return Shard(self.first, self.items[:middle]), Shard(self.first + middle, self.items[middle:])


def cut(items: Sequence[Any], size: int) -> list[Shard]:
    """Shards of `size` items, the last one of what is left."""
    return [Shard(first, tuple(items[first : first + size])) for first in range(0, len(items), size)]


@dataclass(frozen=True)
class ShardFolder:
    """The folder of a run's shards."""

    path: Path

    def claim(self, settings: dict[str, Any], shard_size: int) -> int:
        """Note what the results depend on, or make sure that the run found there is the same one.

        Args:
            settings: plain values by name.
            shard_size: items of a shard, if the run is new.

        Returns:
            The items of a shard, as the run was begun with.

        Raises:
            OutputError: the run there has other settings, or its file is damaged.
        """
        path = self.path / RUN_SETTINGS
        if not path.exists():
            write_json(path, {"shard_size": shard_size, "settings": settings})
            return shard_size
        try:
            begun = json.loads(path.read_text(encoding="utf-8"))
            found, size = {**begun["settings"]}, int(begun["shard_size"])
        except (ValueError, KeyError, TypeError):
            raise OutputError(f"{path}: is damaged; choose another folder, or delete {self.path}") from None
        for name in {**settings, **found}:
            if found.get(name) != settings.get(name):
                raise OutputError(
                    f"{path}: the run there was started with {name} = {found.get(name)}, now {settings.get(name)}; "
                    f"choose another folder, or delete {self.path}"
                )
        return size

    def done(self, shards: Iterable[Shard]) -> set[str]:
        """Names of those shards whose results are there and whole; every file is read."""
        # One listing: a file that was looked for and not found may stay unseen on a network mount for a minute.
        with os.scandir(self.path) as entries:
            there = {entry.name for entry in entries}
        return {shard.name for shard in shards if self._file(shard).name in there and self._is_whole(shard)}

    def write(self, shard: Shard, lines: Iterable[str]) -> None:
        """Write a shard's results, a line of JSON with its end for each item; they appear when all are written."""
        with atomic_path(self._file(shard)) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
            file.writelines(sealed(line[:-1], _key(shard, number)) for number, line in enumerate(lines))

    def join(self, shard: Shard, parts: Sequence[Shard]) -> None:
        """Make the results of a shard from those of its parts, which are removed."""
        self.write(shard, self.lines(sorted(parts)))
        for part in parts:
            self._file(part).unlink()

    def lines(self, shards: Iterable[Shard]) -> Iterator[str]:
        """The results of the shards, in their order.

        Raises:
            OutputError: one is not there, or damaged.
        """
        for shard in shards:
            try:
                yield from self._lines(shard)
            except _DamagedError:
                raise OutputError(
                    f"{self._file(shard)}: is damaged; give the same command again, and its items are done again"
                ) from None
            except FileNotFoundError:
                raise OutputError(
                    f"{self._file(shard)}: a worker has written it, and it is not to be seen here; give a folder that "
                    "is the same on every machine, then the same command again"
                ) from None

    def _is_whole(self, shard: Shard) -> bool:
        try:
            for _ in self._lines(shard):
                pass
        except (_DamagedError, OSError):
            return False
        return True

    def _lines(self, shard: Shard) -> Iterator[str]:
        """The lines of one shard; _DamagedError at the first that is not what was written, or if some are missing."""
        count = 0
        with self._file(shard).open("rb") as file:
            for line in file:
                text = unsealed(line, _key(shard, count))
                if text is None:
                    raise _DamagedError
                yield text + "\n"
                count += 1
        if count != len(shard.items):
            raise _DamagedError

    def _file(self, shard: Shard) -> Path:
        return self.path / f"{shard.name}{_SUFFIX}"


class _DamagedError(Exception):
    """The file of a shard is not what was written."""


def _key(shard: Shard, number: int) -> str:
    """Return the key of a line's digest: the line belongs to one item of one shard."""
    return f"{shard.name} {number}"
