"""Work cut into shards whose results appear at once or not at all, and the order of retries when a worker dies."""

import hashlib
import json
import os
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, Literal, NamedTuple, Protocol, TypeVar

from asca_pillars.base.errors import OutputError
from asca_pillars.base.files import add_checksum, atomic_path, verify_checksum, write_json

RUN_SETTINGS = "run.json"
_SUFFIX = ".jsonl"


class Shard(NamedTuple):
    """Successive items of a run: the number of the first one, and the items, plain values that JSON can hold."""

    first: int
    items: tuple[Any, ...]

    @property
    def name(self) -> str:
        """File name of the shard; it differs for other items."""
        return f"{self.first:09d}-{hashlib.sha256(json.dumps(self.items).encode()).hexdigest()[:12]}"

    @property
    def split(self) -> tuple["Shard", "Shard"]:
        """Two shards of these items; there must be at least two."""
        middle = len(self.items) // 2
        return Shard(self.first, self.items[:middle]), Shard(self.first + middle, self.items[middle:])


def make_shards(items: Sequence[Any], size: int) -> list[Shard]:
    """Cut items into shards of `size`; the last one holds the rest."""
    return [Shard(first, tuple(items[first : first + size])) for first in range(0, len(items), size)]


@dataclass(frozen=True)
class ShardFolder:
    """The folder of a run's shards."""

    path: Path

    def begin(self, settings: dict[str, Any], shard_size: int) -> int:
        """Write the settings that the results depend on, or check that those of the run found there are the same.

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
            stored, size = {**begun["settings"]}, int(begun["shard_size"])
        except (ValueError, KeyError, TypeError):
            raise OutputError(f"{path}: is damaged; choose another folder, or delete {self.path}") from None
        for name in {**settings, **stored}:
            if stored.get(name) != settings.get(name):
                raise OutputError(
                    f"{path}: the run there was started with {name} = {stored.get(name)}, now {settings.get(name)}; "
                    f"choose another folder, or delete {self.path}"
                )
        return size

    def done(self, shards: Iterable[Shard]) -> set[str]:
        """Return the names of those shards whose results are present and intact; every file is read."""
        # One listing: a file that was looked for and not found may stay unseen on a network mount for a minute.
        with os.scandir(self.path) as entries:
            there = {entry.name for entry in entries}
        return {shard.name for shard in shards if self._file(shard).name in there and self._is_whole(shard)}

    def write(self, shard: Shard, lines: Iterable[str]) -> None:
        """Write a shard's results, a line of JSON with its end for each item; they appear when all are written."""
        with atomic_path(self._file(shard)) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
            file.writelines(add_checksum(line[:-1], _key(shard, number)) for number, line in enumerate(lines))

    def join(self, shard: Shard, parts: Sequence[Shard]) -> None:
        """Make the results of a shard from those of its parts, which are removed."""
        self.write(shard, self.lines(sorted(parts)))
        for part in parts:
            self._file(part).unlink()

    def lines(self, shards: Iterable[Shard]) -> Iterator[str]:
        """Yield the results of the shards in their order.

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
        """Yield the lines of one shard; _DamagedError at the first that is not as written, or if some are missing."""
        count = 0
        with self._file(shard).open("rb") as file:
            for line in file:
                text = verify_checksum(line, _key(shard, count))
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


Result = TypeVar("Result")

TRIES = {"worker": 3, "machine": 10, "file system": 3}
"""Deaths of the worker or its machine after which a shard is halved, or given up if it is a single item. A machine's
death says little about the shard; a worker's may be its fault. Also the number of attempts at a file system."""


@dataclass(frozen=True)
class Outcome(Generic[Result]):
    """The end of a shard: its result, or what stopped it.

    Attributes:
        shard: the shard.
        result: return value of the job.
        error: exception of the job.
        died: part that ended before the job did.
        repeats: number of times the shard was restarted.
    """

    shard: Shard
    result: Result | None = None
    error: Exception | None = None
    died: Literal["worker", "machine"] | None = None
    repeats: int = 0


class Pool(Protocol[Result]):
    """Workers that do a job for one shard after another."""

    def has_room(self) -> bool:
        """Return whether one more shard is to be submitted."""

    def submit(self, shard: Shard) -> None:
        """Begin a shard, or let it wait for a free worker."""

    def wait(self) -> list[Outcome[Result]]:
        """Wait until shards have ended; none if all have."""


def process_shards(shards: Iterable[Shard], pool: Pool[Result]) -> Iterator[Outcome[Result]]:
    """Process all shards; yields each one as it ends, in any order.

    A shard whose worker died is done again. One that ends its workers every time is halved until the item that does
    so is alone; that one is yielded with `died` instead of a result.

    Raises:
        Exception: that of the job. An OSError is tried again before: network mounts fail now and then.
    """
    coming, again = iter(shards), deque[Shard]()
    failures = Counter[tuple[str, str]]()
    repeats = Counter[str]()
    while True:
        while pool.has_room() and (shard := again.popleft() if again else next(coming, None)) is not None:
            pool.submit(shard)
        ended = pool.wait()
        if not ended:
            return
        for outcome in ended:
            name = outcome.shard.name
            cause = "file system" if isinstance(outcome.error, OSError) else outcome.died
            if cause is None:
                if outcome.error is not None:
                    raise outcome.error
                yield replace(outcome, repeats=repeats[name])
                continue
            failures[name, cause] += 1
            if failures[name, cause] < TRIES[cause]:
                repeats[name] += 1
                again.append(outcome.shard)
            elif outcome.error is not None:
                raise outcome.error
            elif len(outcome.shard.items) > 1:
                again.extend(outcome.shard.split)
            else:
                yield replace(outcome, repeats=repeats[name])
