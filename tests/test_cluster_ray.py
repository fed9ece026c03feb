"""Ray itself: two nodes, one of which dies; a worker that dies; and machines that are not set up alike."""

import os
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from asca_pillars.base.errors import ClusterError
from asca_pillars.base.progress import Reporter
from asca_pillars.cluster import (
    RayPool,
    Shard,
    connected,
    make_shards,
    process_shards,
    run_items,
    run_shards,
)

pytest.importorskip("ray", reason="needs pip install -e '.[cluster]'")

NODE = {"num_cpus": 1, "object_store_memory": 80 * 2**20, "include_dashboard": False}
DEADLY = 5


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        nodes = Cluster(initialize_head=True, head_node_args=NODE)
        nodes.add_node(**NODE)
        yield nodes
        nodes.shutdown()


def processes(folder: Path) -> set[str]:
    return {path.name.split("-")[1] for path in folder.iterdir()}


def sum_slowly(folder: Path, shard: Shard) -> int:
    (folder / f"{shard.first}-{os.getpid()}").touch()
    deadline = time.monotonic() + 60
    while len(processes(folder)) < 2 and time.monotonic() < deadline:  # one node may begin long after the other
        time.sleep(0.01)
    time.sleep(0.2)
    if shard.items == (DEADLY,) or (DEADLY in shard.items and len(shard.items) < 3):
        os._exit(1)
    return sum(shard.items)


def touch(folder: Path, item: int) -> None:
    (folder / str(item)).touch()


@pytest.mark.filterwarnings("default")  # of Ray
def test_all_is_done_while_a_machine_and_workers_die(cluster: Any, tmp_path: Path) -> None:
    seen, work = tmp_path / "run.json", tmp_path / "work"
    seen.write_text("{}")
    work.mkdir()
    shards = [*make_shards(range(10, 40), 2), Shard(100, (DEADLY,))]
    (node,) = cluster.worker_nodes
    outcomes = []
    for outcome in run_shards(
        partial(sum_slowly, work),
        shards,
        cluster.address,
        seen=seen,
        folders=[work],
        title="Adding",
        reporter=Reporter(),
    ):
        outcomes.append(outcome)
        if len(outcomes) == 3:
            cluster.remove_node(node, allow_graceful=False)
    assert sorted(outcome.shard for outcome in outcomes) == sorted(shards)
    assert sum(outcome.result or 0 for outcome in outcomes) == sum(range(10, 40))
    assert [outcome.shard.items for outcome in outcomes if outcome.died] == [(DEADLY,)]
    assert len(processes(work)) >= 3 + 1, "both nodes, and a new worker after each death"
    assert sum(outcome.repeats for outcome in outcomes) >= 2 + 1, "the deadly one twice, and that of the machine"


@pytest.mark.filterwarnings("default")
def test_machines_that_are_not_alike_are_named(cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "out").mkdir()
    with connected(cluster.address) as about:
        assert about.startswith("Ray: ") and about.endswith("CPUs")
        elsewhere = RayPool(partial(touch, tmp_path), tmp_path / "only here")
        with pytest.raises(ClusterError, match=r"does not see .*only here; write to a folder that every"):
            list(process_shards([Shard(0, (1,))], elsewhere))
        monkeypatch.setattr("asca_pillars.cluster._version", lambda: "9.9")
        (tmp_path / "only here").touch()
        with pytest.raises(ClusterError, match=r"has asca-pillars \S+, the command 9\.9; install one version"):
            list(process_shards([Shard(0, (1,))], elsewhere))
        monkeypatch.undo()


@pytest.mark.filterwarnings("default")
def test_each_item_is_done(cluster: Any, tmp_path: Path) -> None:
    seen, out = tmp_path / "run.json", tmp_path / "out"
    seen.write_text("{}")
    out.mkdir()
    left = out / ".1.asca-00000000"
    left.touch()
    job = partial(touch, out)
    run_items(
        job, range(5), cluster.address, shard_size=2, seen=seen, folders=[out], title="Touching", reporter=Reporter()
    )
    assert {path.name for path in out.iterdir()} == set("01234"), "and what a killed writer left is gone"


@pytest.mark.filterwarnings("default")
def test_a_job_that_no_machine_is_large_enough_for_is_noticed(cluster: Any, tmp_path: Path) -> None:
    with connected(cluster.address):
        assert RayPool(partial(touch, tmp_path), tmp_path, cpus=1).fits()
        assert not RayPool(partial(touch, tmp_path), tmp_path, cpus=2).fits(), "two machines of one CPU"
        assert not RayPool(partial(touch, tmp_path), tmp_path, gpus=1).fits()


def test_no_cluster_is_one_line() -> None:
    for address, reason in (("127.0.0.1:9", "refused"), ("nonsense", "Invalid address")):
        named = rf"--cluster {address}: .*{reason}.*; give HOST:PORT"
        with pytest.raises(ClusterError, match=named) as caught, connected(address):
            pass
        assert "\n" not in str(caught.value)
