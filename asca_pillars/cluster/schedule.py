"""Which shard is done next, and what becomes of one whose worker dies."""

from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Generic, Literal, Protocol, TypeVar

from asca_pillars.cluster.shards import Shard

Result = TypeVar("Result")

TRIES = {"worker": 3, "machine": 10, "file system": 3}
"""After so many deaths of the worker or the machine under it a shard is halved, or given up if it is a single item. A
machine's death says little of the shard; a worker's may well be its work. A file system gets so many tries."""


@dataclass(frozen=True)
class Outcome(Generic[Result]):
    """How a shard ended.

    Attributes:
        shard: which.
        result: what the job returned.
        error: what the job raised.
        died: what ended before the job did.
        repeats: how often the shard had to be begun again.
    """

    shard: Shard
    result: Result | None = None
    error: Exception | None = None
    died: Literal["worker", "machine"] | None = None
    repeats: int = 0


class Pool(Protocol[Result]):
    """Workers that do a job for one shard after another."""

    def has_room(self) -> bool:
        """Whether one more shard is wanted."""

    def submit(self, shard: Shard) -> None:
        """Begin a shard, or let it wait for a free worker."""

    def wait(self) -> list[Outcome[Result]]:
        """Wait until shards have ended; none if all have."""


def work_off(shards: Iterable[Shard], pool: Pool[Result]) -> Iterator[Outcome[Result]]:
    """Have all shards done; yields each one as it ends, in any order.

    A shard whose worker died is done again. One that ends its workers every time is halved until the item that does
    so is alone; that one is yielded with `died` instead of a result.

    Raises:
        Exception: that of the job. An OSError is tried again before: network mounts have bad moments.
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
                again.extend(outcome.shard.halves)
            else:
                yield replace(outcome, repeats=repeats[name])
