"""A run of shards from its start to its end: the cluster, the progress, and the folders that machines write to."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from asca_pillars.base.errors import ClusterError
from asca_pillars.base.locks import recover
from asca_pillars.base.progress import Reporter
from asca_pillars.cluster.ray_pool import RayPool, connected
from asca_pillars.cluster.shards import Outcome, Result, Shard, make_shards, process_shards


def run_shards(
    job: Callable[[Shard], Result],
    shards: Sequence[Shard],
    address: str,
    *,
    seen: Path,
    folders: Sequence[Path],
    title: str,
    reporter: Reporter,
    done: int = 0,
    cpus: int = 1,
    gpus: int = 0,
) -> Iterator[Outcome[Result]]:
    """Do a job for each shard on a cluster; yields each one as it ends, as `process_shards`.

    Args:
        job: as for `RayPool`, as are `seen`, `cpus` and `gpus`.
        shards: shards to do.
        address: address of the cluster; `local` for this machine alone.
        folders: folders that the job writes into. Leftovers of killed workers are removed before and after the run.
        title: name of the step for the progress, which counts items.
        reporter: for the progress, and told which cluster it is and of a machine that is missing.
        done: number of items that an earlier run has done.

    Raises:
        ClusterError: the cluster cannot be used.
        Exception: that of the job.
    """
    for folder in folders:
        recover(folder)
    try:
        with connected(address) as cluster:
            reporter.remark(cluster)
            total = done + sum(len(shard.items) for shard in shards)
            reporter.progress(title, done, total)
            pool = RayPool(job, seen, cpus=cpus, gpus=gpus)
            if not pool.fits():
                needed = f"{cpus} CPU{'s'[: cpus > 1]}" + (" and a GPU" if gpus else "")
                reporter.remark(
                    f"no machine of the cluster has {needed}, which each worker takes: waiting for one to join"
                )
            for outcome in process_shards(shards, pool):
                done += len(outcome.shard.items)
                reporter.progress(title, done, total)
                yield outcome
    finally:
        for folder in folders:
            recover(folder)


def run_items(
    job: Callable[[Any], None],
    items: Sequence[Any],
    address: str,
    *,
    shard_size: int,
    seen: Path,
    folders: Sequence[Path],
    title: str,
    reporter: Reporter,
) -> None:
    """Do a job that returns nothing for each item on a cluster, `shard_size` of them by one worker.

    Args:
        job: called with an item on a worker, perhaps more than once. The others: as for `run_shards`.

    Raises:
        ClusterError: the cluster cannot be used; or, after all others are done, some items ended every worker.
        Exception: that of the job.
    """
    if not items:
        return
    lost: list[Any] = []
    shards = make_shards(items, shard_size)
    for outcome in run_shards(
        partial(_run_shard, job), shards, address, seen=seen, folders=folders, title=title, reporter=reporter
    ):
        lost += outcome.shard.items if outcome.died else ()
    if lost:
        raise ClusterError(f"{title}: {', '.join(map(str, lost))} ended each process that worked on it")


def _run_shard(job: Callable[[Any], None], shard: Shard) -> None:
    for item in shard.items:
        job(item)
