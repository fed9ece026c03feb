"""Work cut into shards on many machines: results appear at once or not at all, and a shard is tried again.

Shards run on the workers of a Ray cluster; no other module uses Ray. A run goes from the cluster's start over its
progress to the folders that the machines write to.
"""

import contextlib
import hashlib
import json
import logging
import os
import socket
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, Literal, NamedTuple, Protocol, TypeVar

from asca_pillars.base.errors import ClusterError, OutputError
from asca_pillars.base.files import add_checksum, atomic_path, verify_checksum, write_json
from asca_pillars.base.locks import recover
from asca_pillars.base.progress import Reporter
from asca_pillars.base.system import default_threads, package_versions

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
            earlier = json.loads(path.read_text(encoding="utf-8"))
            stored, size = {**earlier["settings"]}, int(earlier["shard_size"])
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
            names = {entry.name for entry in entries}
        return {shard.name for shard in shards if self._file(shard).name in names and self._is_whole(shard)}

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
                    f"{self._file(shard)}: is damaged; run the same command again, which redoes its items"
                ) from None
            except FileNotFoundError:
                raise OutputError(
                    f"{self._file(shard)}: a worker has written it, but it is not visible here; give a folder that "
                    "every machine mounts at the same path, then run the same command again"
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
        return any(
            resource.get("CPU", 0) >= self._cpus and resource.get("GPU", 0) >= self._gpus for resource in resources
        )

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
        raise ClusterError(f"{host}: does not see {seen}; write to a folder that every machine mounts at the same path")
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
                    f"no machine of the cluster has {needed}, which each worker needs: waiting for one to join"
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
