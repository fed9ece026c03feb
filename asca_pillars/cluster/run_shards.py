"""A run of shards from its start to its end: the cluster, the progress, and the folders that machines write to.

No other module uses Ray, on whose workers the shards of a cluster run.
"""

import contextlib
import logging
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Generic

from asca_pillars.base.errors import ClusterError
from asca_pillars.base.locks import recover
from asca_pillars.base.progress import Reporter
from asca_pillars.base.system import default_threads, package_versions
from asca_pillars.cluster.shards import Outcome, Result, Shard, make_shards, process_shards

LOCAL = "local"
_OBJECT_STORE_BYTES = 100 * 2**20  # nothing but names and counts passes through it
_LEAST_IN_FLIGHT = 8
_RESOURCES_HOLD_S = 10.0
_CONNECT_S = 10.0


@contextlib.contextmanager
def connected(address: str) -> Iterator[str]:
    """Join the cluster at an address, or start Ray on this machine for `local`; yields a description of it.

    Raises:
        ClusterError: there is no such cluster, or it does not let this process in.
    """
    import ray

    local = {"num_cpus": default_threads(), "include_dashboard": False, "object_store_memory": _OBJECT_STORE_BYTES}
    try:
        _require_listener(address)
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR, **(local if address == LOCAL else {}))
    except (OSError, RuntimeError, ValueError) as error:
        reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
        raise ClusterError(
            f"--cluster {address}: {reason}; give HOST:PORT of a running cluster (ray start --head), auto or {LOCAL}"
        ) from None
    try:
        machines = sum(node["Alive"] for node in ray.nodes())
        yield f"Ray: {machines} machine{'s'[: machines > 1]}, {ray.cluster_resources().get('CPU', 0):g} CPUs"
    finally:
        ray.shutdown()


class RayPool(Generic[Result]):
    """Does a job for shards on the workers of the connected cluster.

    Args:
        job: called with a shard on a worker; it and its result have to be picklable.
        seen: a file that every machine must see, so that results do not go to a local disk.
        cpus: CPUs of a job.
        gpus: GPUs of a job.
    """

    def __init__(self, job: Callable[[Shard], Result], seen: Path, *, cpus: int = 1, gpus: int = 0) -> None:
        import ray

        # No retries of Ray's own: a shard that ends its worker every time has to be noticed.
        options = {"num_cpus": cpus, "num_gpus": gpus, "max_retries": 0}
        self._task = ray.remote(_on_worker).options(**options)
        self._job, self._seen, self._cpus, self._gpus = job, seen.absolute(), cpus, gpus
        self._running: dict[Any, Shard] = {}
        self._limit, self._limit_until = 0, 0.0

    def has_room(self) -> bool:
        """Return whether one more shard is to be submitted: each worker has one waiting, and the queue stays short."""
        import ray

        if time.monotonic() >= self._limit_until:  # machines come and go
            workers = ray.cluster_resources().get("CPU", 0) // self._cpus
            self._limit = max(_LEAST_IN_FLIGHT, 2 * int(workers))
            self._limit_until = time.monotonic() + _RESOURCES_HOLD_S
        return len(self._running) < self._limit

    def fits(self) -> bool:
        """Return whether a machine of the cluster is large enough for a job; if not, jobs wait until one joins."""
        import ray

        resources = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        return any(one.get("CPU", 0) >= self._cpus and one.get("GPU", 0) >= self._gpus for one in resources)

    def submit(self, shard: Shard) -> None:
        """Begin a shard, or let it wait for a free worker."""
        self._running[self._task.remote(self._job, shard, self._seen, _version())] = shard

    def wait(self) -> list[Outcome[Result]]:
        """Wait until shards have ended; none if all have."""
        import ray

        if not self._running:
            return []
        ended, _ = ray.wait(list(self._running), num_returns=1)
        return [_outcome(reference, self._running.pop(reference)) for reference in ended]


def _require_listener(address: str) -> None:
    """Raise OSError if nothing listens at HOST:PORT: Ray itself would try for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host, int(port)), timeout=_CONNECT_S).close()


def _outcome(reference: Any, shard: Shard) -> Outcome[Any]:
    import ray
    from ray import exceptions

    try:
        return Outcome(shard, result=ray.get(reference))
    except exceptions.RayTaskError as error:
        cause = error.cause
        return Outcome(shard, error=cause if isinstance(cause, Exception) else error)
    except (exceptions.NodeDiedError, exceptions.LocalRayletDiedError):
        return Outcome(shard, died="machine")
    except (exceptions.WorkerCrashedError, exceptions.OutOfMemoryError):
        return Outcome(shard, died="worker")


def _on_worker(job: Callable[[Shard], Result], shard: Shard, seen: Path, version: str | None) -> Result:
    host = socket.gethostname()
    if (local := _version()) != version:
        raise ClusterError(f"{host}: has asca-pillars {local}, the command {version}; install one version everywhere")
    if not seen.is_file():
        raise ClusterError(f"{host}: does not see {seen}; write to a folder that every machine mounts at that place")
    return job(shard)


def _version() -> str | None:
    return package_versions().get("asca-pillars")


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
