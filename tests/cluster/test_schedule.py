"""What becomes of shards whose workers die: all are done, once, and one that kills is found."""

import random
from collections import Counter, deque
from collections.abc import Callable
from typing import Literal

import pytest

from asca_pillars.base.errors import BundleError
from asca_pillars.cluster.shards import TRIES, Outcome, Shard, make_shards, process_shards


class MadeUpPool:
    """Workers that end each shard as `end` says; the last one submitted may end first."""

    def __init__(self, end: Callable[[Shard], Outcome[int]], room: int = 3) -> None:
        self._end, self._room = end, room
        self._running: deque[Shard] = deque()
        self.begun = Counter[str]()

    def has_room(self) -> bool:
        return len(self._running) < self._room

    def submit(self, shard: Shard) -> None:
        assert self.has_room()
        self._running.append(shard)
        self.begun[shard.name] += 1

    def wait(self) -> list[Outcome[int]]:
        return [self._end(self._running.pop())] if self._running else []


def done(shard: Shard) -> Outcome[int]:
    return Outcome(shard, result=sum(shard.items))


def died(shard: Shard, what: Literal["worker", "machine"] = "worker") -> Outcome[int]:
    return Outcome(shard, died=what)


def test_all_are_done_once_while_machines_die() -> None:
    rng = random.Random(0)
    pool = MadeUpPool(lambda shard: died(shard, "machine") if rng.random() < 0.4 else done(shard))
    shards = make_shards(range(100), 7)
    outcomes = list(process_shards(shards, pool))
    assert sorted(outcome.shard for outcome in outcomes) == shards
    assert sum(outcome.result or 0 for outcome in outcomes) == sum(range(100))
    assert sum(outcome.repeats for outcome in outcomes) == sum(pool.begun.values()) - len(shards) > 0


def test_the_item_that_ends_its_workers_is_found_and_the_others_are_done() -> None:
    pool = MadeUpPool(lambda shard: died(shard) if {13, 77} & set(shard.items) else done(shard))
    outcomes = list(process_shards(make_shards(range(100), 20), pool))
    assert sorted(item for outcome in outcomes for item in outcome.shard.items) == list(range(100))
    assert sorted(outcome.shard.items for outcome in outcomes if outcome.died) == [(13,), (77,)]
    assert max(pool.begun.values()) == TRIES["worker"]


def test_a_machine_is_not_taken_for_the_fault_of_the_shard() -> None:
    deaths = Counter[str]()

    def end(shard: Shard) -> Outcome[int]:
        deaths[shard.name] += 1
        return died(shard, "machine") if deaths[shard.name] < TRIES["machine"] else done(shard)

    (outcome,) = process_shards([Shard(0, (1, 2))], MadeUpPool(end))
    assert (outcome.result, outcome.repeats) == (3, TRIES["machine"] - 1)


def test_a_bad_moment_of_the_file_system_is_waited_out_and_a_full_disk_is_not() -> None:
    tries = Counter[str]()

    def end(shard: Shard, good_after: int) -> Outcome[int]:
        tries[shard.name] += 1
        return done(shard) if tries[shard.name] > good_after else Outcome(shard, error=OSError("no space"))

    outcomes = process_shards(make_shards([1, 2], 1), MadeUpPool(lambda shard: end(shard, 2)))
    assert [one.result for one in outcomes] == [2, 1]
    tries.clear()
    with pytest.raises(OSError, match="no space"):
        list(process_shards([Shard(0, (1,))], MadeUpPool(lambda shard: end(shard, 3))))


def test_what_the_job_raises_ends_the_run() -> None:
    pool = MadeUpPool(lambda shard: Outcome(shard, error=BundleError("another bundle")))
    with pytest.raises(BundleError, match="another bundle"):
        list(process_shards([Shard(0, (1,))], pool))
    assert list(process_shards([], pool)) == []
