"""Does a cluster find what one process finds, also if a machine of it dies, and what does it cost?

    python -m benchmarks.cluster                       # 2,000 tiny scans, 60 simulated frames
    python -m benchmarks.cluster --scans 200 --frames 0

Two Ray nodes of one CPU each run on this machine. `asca detect` and `asca simulate` are run by one process, on the
cluster undisturbed, and on the cluster while the second node is killed (SIGKILL, its workers with it) when half of the
work is there. What is written has to be the same bytes each time. Scans have 300 points and the model has random
weights and a tiny grid, so that the cost of the cluster is not lost beside that of the network.

Costs are processor time of all processes below this one, looked at 20 times a second. That of a scan is without the
start of the processes: what a run costs more than one of a few scans. The work itself is what a worker does for a
shard, measured in this process: read, detect, write. The cost of the cluster is the difference.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from asca_pillars.cluster.shards import cut
from asca_pillars.commands.detect_archive import DetectShard, bundle_digest
from asca_pillars.commands.options import RuntimeOptions
from asca_pillars.data.mounting import Mounting
from asca_pillars.data.scans.scan_reader import write_scan
from tests.deploy.conftest import make_scan, write_bundle

POINTS = 300
START_SCANS = 32  # of the run whose cost is that of starting
POLL_S = 0.05
NODE = {"num_cpus": 1, "object_store_memory": 80 * 2**20, "include_dashboard": False}
_TICKS = os.sysconf("SC_CLK_TCK")


@dataclass
class Run:
    """A command that ran: seconds of processor time and of wall time, and what it printed."""

    cpu_s: float
    wall_s: float
    text: str


class CpuMeter:
    """Processor time of all processes below this one, also of those that have ended."""

    def __enter__(self) -> "CpuMeter":
        self._first, self._last = self._look(), dict[tuple[int, int], float]()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._last |= self._look()

    @property
    def seconds(self) -> float:
        """Since the block was entered."""
        return sum(seconds - self._first.get(process, 0.0) for process, seconds in self._last.items())

    def _watch(self) -> None:
        while not self._stop.wait(POLL_S):
            self._last |= self._look()

    @staticmethod
    def _look() -> dict[tuple[int, int], float]:
        parents, seconds, ids = {}, {}, {}
        for path in Path("/proc").glob("[0-9]*/stat"):
            try:
                fields = path.read_text().rpartition(")")[2].split()
            except OSError:  # it has ended
                continue
            number = int(path.parent.name)
            parents[number], ids[number] = int(fields[1]), (number, int(fields[19]))
            seconds[number] = (int(fields[11]) + int(fields[12])) / _TICKS
        below = {os.getpid()}
        for number in sorted(parents, key=lambda one: ids[one][1]):  # parents are older
            if parents[number] in below:
                below.add(number)
        return {ids[number]: seconds[number] for number in below - {os.getpid()}}


def main(
    scans: Annotated[int, typer.Option(min=64)] = 2000,
    frames: Annotated[int, typer.Option(min=0, help="To simulate; 0 for none.")] = 60,
    out: Annotated[Path | None, typer.Option("--json", help="Also write the figures to this file.")] = None,
) -> None:
    """Run, kill, compare; the exit code is 1 if anything differs or is left behind."""
    from ray.cluster_utils import Cluster

    console = Console(markup=False, highlight=False)
    cluster = Cluster(initialize_head=True, head_node_args=NODE)
    try:
        with tempfile.TemporaryDirectory(prefix="asca-cluster-") as folder:
            root = Path(folder)
            figures = _detect(cluster, root, scans, console)
            if frames:
                figures |= _simulate(cluster, root, frames, console)
    finally:
        cluster.shutdown()
    if out is not None:
        out.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    raise typer.Exit(int(not all(value for name, value in figures.items() if name.endswith("the same"))))


def _detect(cluster: Any, root: Path, scans: int, console: Console) -> dict[str, Any]:
    bundle = write_bundle(root / "bundle")
    for number in range(scans):
        write_scan(root / "scans" / f"{number}.bin", make_scan(number, POINTS))
        if number < START_SCANS:
            write_scan(root / "few" / f"{number}.bin", make_scan(number, POINTS))

    def command(out: str, source: str = "scans") -> list[str]:
        return ["detect", str(root / source), "--out", str(root / out), "--bundle", str(bundle)]

    def shards(out: str) -> int:
        return sum(1 for _ in (root / out / "shards").glob("0*.jsonl"))

    work_ms = _work_itself(root, bundle)
    one = ["--threads", "1", "--no-pictures"]
    there = ["--cluster", cluster.address]
    few, alone = _run(command("alone few", "few") + one), _run(command("alone") + one)
    node = cluster.add_node(**NODE)
    started, whole = _run(command("few on cluster", "few") + there), _run(command("whole") + there)
    wanted = shards("whole") // 2
    killed = _run(
        command("killed") + there,
        when=lambda: shards("killed") >= wanted,
        then=lambda: cluster.remove_node(node, allow_graceful=False),
    )
    results = {name: (root / name / "detections.jsonl").read_bytes() for name in ("alone", "whole", "killed")}
    more = scans - START_SCANS
    figures = {
        "scans": scans,
        "results": len(results["killed"].splitlines()),
        "shards": shards("whole"),
        "undisturbed: the same": results["whole"] == results["alone"],
        "killed: the same": results["killed"] == results["alone"] and not _left(root / "killed"),
        "killed when done": wanted / shards("whole"),
        "begun again": next((line for line in killed.text.splitlines() if "begun again" in line), "nothing"),
        "one process, CPU ms per scan": 1e3 * (alone.cpu_s - few.cpu_s) / more,
        "the work itself, CPU ms per scan": work_ms,
        "cluster, CPU ms per scan": 1e3 * (whole.cpu_s - started.cpu_s) / more,
        "one process, CPU s to start": few.cpu_s,
        "cluster, CPU s to start": started.cpu_s,
        "wall s: one process / cluster / with a kill": [alone.wall_s, whole.wall_s, killed.wall_s],
    }
    console.print(json.dumps(figures, indent=1))
    return figures


def _work_itself(root: Path, bundle: Path) -> float:
    job = DetectShard(
        shards=root / "work",
        start=root,
        options=RuntimeOptions(bundle=bundle, threads=1),
        score=None,
        mounting=Mounting(),
        around=False,
        columns=None,
        bundle_sha256=bundle_digest(bundle),
    )
    scans = [(str(path), "auto") for path in sorted((root / "scans").iterdir())]
    first, *shards = cut(scans, 16)
    job(first)  # opens the detector
    start = time.process_time()
    for shard in shards:
        job(shard)
    return 1e3 * (time.process_time() - start) / (len(scans) - 16)


def _simulate(cluster: Any, root: Path, frames: int, console: Console) -> dict[str, Any]:
    def command(out: str) -> list[str]:
        return ["simulate", str(root / out), "-n", str(frames), "--view", "camera", "--seed", "5"]

    _run([*command("frames alone"), "--workers", "1"])
    node = cluster.add_node(**NODE)
    scans = root / "frames killed" / "training" / "velodyne"
    _run(
        [*command("frames killed"), "--cluster", cluster.address],
        when=lambda: sum(1 for _ in scans.glob("0*.bin")) >= frames // 2,
        then=lambda: cluster.remove_node(node, allow_graceful=False),
    )
    alone, killed = (_files(root / name) for name in ("frames alone", "frames killed"))
    figures = {"frames": frames, "frames killed: the same": alone == killed and not _left(root / "frames killed")}
    console.print(json.dumps(figures, indent=1))
    return figures


def _run(arguments: list[str], when: Callable[[], bool] | None = None, then: Callable[[], None] = lambda: None) -> Run:
    """Run `asca ARGUMENTS`; do `then` once, as soon as `when` is true.

    Raises:
        RuntimeError: the command failed, or `when` never was.
    """
    start = time.perf_counter()
    with CpuMeter() as meter:
        process = subprocess.Popen(
            [sys.executable, "-m", "asca_pillars.cli", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        try:
            while process.poll() is None and when is not None:
                if when():
                    then()
                    when = None
                time.sleep(0.01)
            text, _ = process.communicate()
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            raise
    if process.returncode or when is not None:
        raise RuntimeError(f"asca {' '.join(arguments)}: {text[-3000:] if process.returncode else 'ended too early'}")
    return Run(meter.seconds, time.perf_counter() - start, text)


def _files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _left(folder: Path) -> list[Path]:
    """Temporary files of the writers that were killed."""
    return list(folder.rglob(".*.asca-*"))


if __name__ == "__main__":
    typer.run(main)
