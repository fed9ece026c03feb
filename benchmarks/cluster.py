"""Equality of a cluster's results with those of one process, also after a node's failure, and the cluster's cost.

    python -m benchmarks.cluster                       # 2,000 tiny scans, 60 simulated frames
    python -m benchmarks.cluster --scans 200 --frames 0

Two Ray nodes of one CPU each run on this machine. `asca detect` and `asca simulate` are run by one process, on the
cluster undisturbed, and on the cluster while the second node is killed (SIGKILL, its workers with it) when half of the
work is done. The output must be the same bytes each time. Scans have 300 points and the model has random
weights and a tiny grid, so that the network's time does not hide the cluster's.

Costs are processor time, of the command, of the workers (with their start) and of Ray's own processes, sampled 20
times a second. The work itself is a worker's job for a shard, measured in this process: read, detect, write. The
remaining time of the undisturbed run is the cost of the cluster; the cost of one more scan is the difference to a run
over a quarter of the scans, in the command and the workers.
"""

import contextlib
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

from asca_deploy.detect_archive import DetectShard, bundle_digest
from asca_deploy.open_model import RuntimeOptions
from asca_pillars.base.files import write_json
from asca_pillars.cli.run_command import run_command
from asca_pillars.cluster import make_shards
from asca_pillars.scans.mounting import Mounting
from asca_pillars.scans.scan_reader import write_scan
from tests.deploy.conftest import make_scan, write_bundle

POINTS = 300
POLL_S = 0.05
NODE = {"num_cpus": 1, "object_store_memory": 80 * 2**20, "include_dashboard": False}
AT_WORK = "ray::_on_worker"  # name of a worker's process while it runs a shard
_TICKS = os.sysconf("SC_CLK_TCK")


@dataclass
class Run:
    """Finished command: seconds of processor time by kind of process, seconds of wall time, and its output."""

    cpu_s: dict[str, float]
    wall_s: float
    text: str


class CpuMeter:
    """Meter of the processor time of all child processes, including ended ones: workers, Ray's own, others."""

    def __enter__(self) -> "CpuMeter":
        self._first, self._last = self._look(), dict[tuple[str, int, int], float]()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._last |= self._look()

    @property
    def seconds(self) -> dict[str, float]:
        """Return the seconds since the start of the block, by kind."""
        sums = dict.fromkeys(("command", "workers", "Ray"), 0.0)
        for process, seconds in self._last.items():
            sums[process[0]] += seconds - self._first.get(process, 0.0)
        return {kind: round(seconds, 2) for kind, seconds in sums.items()}

    def _watch(self) -> None:
        while not self._stop.wait(POLL_S):
            self._last |= self._look()

    @staticmethod
    def _look() -> dict[tuple[str, int, int], float]:
        found = {}
        for number, fields in _processes_below(os.getpid()).items():
            seconds = (int(fields[11]) + int(fields[12])) / _TICKS
            found[_kind(_command_line(number)), number, int(fields[19])] = seconds
        return found


def _kind(command_line: str) -> str:
    if "asca_pillars.cli" in command_line:
        return "command"
    return "workers" if _is_worker(command_line) else "Ray"


def _is_worker(command_line: str) -> bool:
    return command_line.startswith((AT_WORK, "ray::IDLE")) or "default_worker.py" in command_line


def _processes_below(root: int) -> dict[int, list[str]]:
    """Return the processes that descend from `root`, with the fields of /proc/ID/stat after their names."""
    stats = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has ended
            stats[int(path.parent.name)] = path.read_text().rpartition(")")[2].split()
    below = {root}
    for number in sorted(stats, key=lambda one: int(stats[one][19])):  # parents are older
        if int(stats[number][1]) in below:
            below.add(number)
    return {number: stats[number] for number in below - {root} if number in stats}


def _command_line(number: int) -> str:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{number}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    return ""


def _kill_at_work(cluster: Any, node: Any) -> bool:
    """Kill a node while one of its workers runs a shard; return False, without action, if none does."""
    raylet = node.all_processes["raylet"][0].process.pid
    for number in _processes_below(raylet):
        if _command_line(number).startswith(AT_WORK):
            os.kill(number, signal.SIGSTOP)
            if _command_line(number).startswith(AT_WORK):  # and not at its end
                os.kill(number, signal.SIGKILL)
                cluster.remove_node(node, allow_graceful=False)
                return True
            os.kill(number, signal.SIGCONT)
    return False


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
        write_json(out, figures)
    raise typer.Exit(int(not all(value for name, value in figures.items() if name.endswith("the same"))))


def _detect(cluster: Any, root: Path, scans: int, console: Console) -> dict[str, Any]:
    bundle = write_bundle(root / "bundle")
    for number in range(scans):
        for name in ("scans", "quarter of scans")[: 1 + (4 * number < scans)]:
            write_scan(root / name / f"{number}.bin", make_scan(number, POINTS))

    def command(out: str, source: str = "scans") -> list[str]:
        return ["detect", str(root / source), "--out", str(root / out), "--bundle", str(bundle)]

    def shards(out: str) -> int:
        return sum(1 for _ in (root / out / "shards").glob("0*.jsonl"))

    work_ms = _work_itself(root, bundle)
    alone = _run([*command("alone"), "--threads", "1", "--no-pictures"])
    there = ["--cluster", cluster.address]
    node = cluster.add_node(**NODE)
    quarter, whole = _run(command("quarter", "quarter of scans") + there), _run(command("whole") + there)
    more = [whole.cpu_s[kind] - quarter.cpu_s[kind] for kind in ("command", "workers")]
    count = shards("whole")
    killed = _run(command("killed") + there, lambda: shards("killed") >= count // 2 and _kill_at_work(cluster, node))
    results = {name: (root / name / "detections.jsonl").read_bytes() for name in ("alone", "whole", "killed")}
    figures = {
        "scans": scans,
        "results": len(results["killed"].splitlines()),
        "shards": count,
        "undisturbed: the same": results["whole"] == results["alone"],
        "killed: the same": results["killed"] == results["alone"] and not _left(root / "killed"),
        "after the kill": next((line for line in killed.text.splitlines() if "begun again" in line), "nothing"),
        "CPU ms per scan: one process": round(1e3 * alone.cpu_s["command"] / scans, 2),
        "CPU ms per scan: the work itself": round(work_ms, 2),
        "CPU ms per scan: cluster": round(1e3 * sum(whole.cpu_s.values()) / scans, 2),
        "CPU ms per scan: cluster, one more scan": round(1e3 * sum(more) / (scans - -(-scans // 4)), 2),
        "CPU s: cluster": whole.cpu_s,
        "wall s: one process, cluster, with a kill": [round(run.wall_s, 1) for run in (alone, whole, killed)],
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
    first, *shards = make_shards(scans, 16)
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
        lambda: sum(1 for _ in scans.glob("0*.bin")) >= frames // 2 and _kill_at_work(cluster, node),
    )
    alone, killed = (_files(root / name) for name in ("frames alone", "frames killed"))
    figures = {"frames": frames, "frames killed: the same": alone == killed and not _left(root / "frames killed")}
    console.print(json.dumps(figures, indent=1))
    return figures


def _run(arguments: list[str], kill: Callable[[], bool] | None = None) -> Run:
    """Run `asca ARGUMENTS`, and `kill` repeatedly until it returns True.

    Raises:
        RuntimeError: the command failed, or ended before the kill.
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
            while process.poll() is None and kill is not None:
                if kill():
                    kill = None
                time.sleep(0.01)
            text, _ = process.communicate()
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            raise
    if process.returncode or kill is not None:
        raise RuntimeError(f"asca {' '.join(arguments)}: {text[-3000:] if process.returncode else 'ended too early'}")
    return Run(meter.seconds, time.perf_counter() - start, text)


def _files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _left(folder: Path) -> list[Path]:
    """Return temporary files of killed writers."""
    return list(folder.rglob(".*.asca-*"))


if __name__ == "__main__":
    run_command(main)
