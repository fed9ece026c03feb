"""Shards: their names, their files, whose run they belong to, and what becomes of those whose workers die."""

import json
import random
from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from asca_pillars.base.errors import BundleError, OutputError
from asca_pillars.cluster import (
    TRIES,
    Outcome,
    Shard,
    ShardFolder,
    make_shards,
    process_shards,
)


@given(items=st.lists(st.integers(), max_size=40), size=st.integers(1, 12))
def test_shards_hold_every_item_once_and_in_order(items: list[int], size: int) -> None:
    shards = make_shards(items, size)
    assert [item for shard in shards for item in shard.items] == items
    assert all(items[shard.first : shard.first + len(shard.items)] == list(shard.items) for shard in shards)
    assert len({shard.name for shard in shards}) == len(shards)
    for shard in shards:
        if len(shard.items) > 1:
            first, second = shard.split
            assert first.items and second.items and first.items + second.items == shard.items
            assert (first.first, second.first) == (shard.first, shard.first + len(first.items))


def test_other_items_have_another_name_and_more_items_keep_the_names_before_them() -> None:
    before, after = make_shards(["a", "b", "c", "d"], 2), make_shards(["a", "b", "c", "x", "y"], 2)
    assert before[0].name == after[0].name and before[1].name != after[1].name
    assert Shard(0, (("a", 255.0),)).name != Shard(0, (("a", 1.0),)).name


def test_results_appear_when_all_are_written(tmp_path: Path) -> None:
    folder, shard = ShardFolder(tmp_path), Shard(0, ("a", "b"))

    def stop_after_one():
        yield "a\n"
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        folder.write(shard, stop_after_one())
    assert folder.done([shard]) == set() and not list(tmp_path.iterdir())
    folder.write(shard, ["a\n", "b\n"])
    (tmp_path / ".000000002-0.asca-00000000.jsonl").write_text("half of a li")  # what a killed writer leaves
    assert folder.done([shard]) == {shard.name}


def test_parts_become_the_shard(tmp_path: Path) -> None:
    folder, shard = ShardFolder(tmp_path), Shard(4, ("a", "b", "c"))
    first, second = shard.split
    for part in (second, first):
        folder.write(part, [f"{item}\n" for item in part.items])
    folder.join(shard, [second, first])
    assert folder.done([shard]) == {shard.name}
    assert list(folder.lines([shard])) == ["a\n", "b\n", "c\n"]


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"".join(content.splitlines(keepends=True)[:1]),  # whole lines, too few
        lambda content: b"".join(content.splitlines(keepends=True)[::-1]),
        lambda content: content[:-3],  # within a line
        lambda content: content[:-1],
        lambda content: b"",
        lambda content: content.replace(b"b", b"c", 1),
        lambda content: b'{"scan": "a", "boxes": []}\n' * 3,  # as earlier versions wrote them
    ],
)
def test_a_damaged_result_is_done_again_and_not_merged(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    folder, shards = ShardFolder(tmp_path), make_shards(["a", "b", "c", "d"], 3)
    for shard in shards:
        folder.write(shard, [json.dumps({"scan": item}) + "\n" for item in shard.items])
    assert folder.done(shards) == {shard.name for shard in shards}
    path = tmp_path / f"{shards[0].name}.jsonl"
    path.write_bytes(damage(path.read_bytes()))
    assert folder.done(shards) == {shards[1].name}
    with pytest.raises(OutputError, match=r"000000000-\w+\.jsonl: is damaged; run the same command again"):
        list(folder.lines(shards))


def test_a_result_that_is_not_there_or_of_another_shard_is_none(tmp_path: Path) -> None:
    folder, shards = ShardFolder(tmp_path), make_shards(["a", "b", "c", "d"], 2)
    folder.write(shards[0], ["1\n", "2\n"])
    (tmp_path / f"{shards[0].name}.jsonl").rename(tmp_path / f"{shards[1].name}.jsonl")
    assert folder.done(shards) == set()
    with pytest.raises(OutputError, match=r"000000003-\w+\.jsonl: .* mounts at the same path"):
        list(folder.lines([Shard(3, ("a",))]))


def test_other_settings_are_refused_and_the_size_stays(tmp_path: Path) -> None:
    folder = ShardFolder(tmp_path / "shards")
    assert folder.begin({"score": None, "mounting": {"axes": "x-forward"}}, 16) == 16
    assert folder.begin({"score": None, "mounting": {"axes": "x-forward"}}, 256) == 16
    with pytest.raises(OutputError, match=r"run\.json: .* score = None, now 0\.5; choose another folder"):
        folder.begin({"score": 0.5, "mounting": {"axes": "x-forward"}}, 16)
    with pytest.raises(OutputError, match="tilt = None, now 1"):
        folder.begin({"score": None, "mounting": {"axes": "x-forward"}, "tilt": 1}, 16)
    for text in ("{", "[]", '{"shard_size": "many", "settings": {}}', '{"shard_size": 4, "settings": []}'):
        (tmp_path / "shards" / "run.json").write_text(text)
        with pytest.raises(OutputError, match="is damaged"):
            folder.begin({}, 16)


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
    with pytest.raises(BundleError, match="another bundle"):  # what the job raises ends the run
        pool = MadeUpPool(lambda shard: Outcome(shard, error=BundleError("another bundle")))
        list(process_shards([Shard(0, (1,))], pool))
    assert list(process_shards([], pool)) == []
