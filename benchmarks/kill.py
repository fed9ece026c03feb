"""Are simulate, prepare, train and export the same after a kill as without one?

    python -m benchmarks.kill --kills 25

Each command runs once undisturbed. Then it is started, killed (SIGKILL, with all its processes) at a random moment
after its first output and before its last, and given again: what is there at the end has to be what the undisturbed
run wrote, and nothing else may be left. A run that was not killed in time does not count and is repeated.

Run it from a checkout that nobody edits meanwhile: an export writes the git revision into its manifest.
"""

import hashlib
import os
import random
import re
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from asca_pillars.base.files import write_json
from asca_pillars.cli.run_command import run_command
from asca_pillars.data.kitti import KittiSplit

POLL_S = 0.002
FRAMES = 10
CONFIG = """name: tiny
model:
  spec: {grid: {x_range_m: [4.8, 25.28], y_range_m: [-6.4, 7.68], v_max_m: 0.32, zones: 2}}
  network: {pillar_channels: 16, block_channels: [16, 24, 32], block_convs: [1, 1, 1], upsample_channels: 16}
augment: {insert: {method: rs_aug, min_points: 1}}
data: {workers: 2}
train: {epochs: 4, batch_size: 2, checkpoint_steps: 1}
"""
_LEFTOVER = re.compile(r"\.asca-[0-9a-f]{8}")


@dataclass(frozen=True)
class Job:
    """A command to kill: its arguments for an output, the files that show its progress, and what it has written."""

    name: str
    arguments: Callable[[Path], list[str]]
    watched: Callable[[Path], list[Path]]
    contents: Callable[[Path], dict[str, str]]


@dataclass(frozen=True)
class Reference:
    """The undisturbed run: how many writes were seen of it, how long from the first to the last, what it wrote."""

    writes: int
    seconds: float
    contents: dict[str, str]


@dataclass(frozen=True)
class Kill:
    """How far a killed run had got (0..1), whether the next one wrote the same, what it left behind."""

    share: float
    identical: bool
    left: tuple[str, ...]


def main(
    kills: Annotated[int, typer.Option(min=1, help="Of each command.")] = 25,
    command: Annotated[list[str] | None, typer.Option(help="Only this command. Repeatable.")] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    out: Annotated[Path | None, typer.Option("--json", help="Also write every kill to this file.")] = None,
) -> None:
    """Kill, run again, compare; the exit code is 1 if anything differs or is left behind."""
    console = Console(markup=False, highlight=False)
    table = Table(title=f"{kills} kills of each command, seed {seed}")
    for column in (
        "command",
        "kills inside",
        "done: least / median / most",
        "identical after",
        "left behind",
    ):
        table.add_column(column, justify="left" if column == "command" else "right")
    results: dict[str, list[Kill]] = {}
    with tempfile.TemporaryDirectory(prefix="asca-kill-") as folder:
        chosen = [job for job in _jobs(Path(folder), console) if not command or job.name in command]
        for job in chosen:
            results[job.name] = done = _kill(job, Path(folder) / job.name, kills, random.Random(seed), console)
            shares = [kill.share for kill in done]
            spread = " / ".join(f"{value:.0%}" for value in (min(shares), statistics.median(shares), max(shares)))
            identical, left = sum(kill.identical for kill in done), sum(bool(kill.left) for kill in done)
            table.add_row(job.name, str(len(done)), spread, str(identical), str(left))
    console.print(table)
    if out is not None:
        rows = {name: [vars(kill) for kill in done] for name, done in results.items()}
        write_json(out, rows)
    raise typer.Exit(int(any(not kill.identical or kill.left for done in results.values() for kill in done)))


def _jobs(folder: Path, console: Console) -> list[Job]:
    """The four commands, on a small simulated dataset and a small network that is trained on it."""
    data, config, run = folder / "data", folder / "tiny.yaml", folder / "run"
    config.write_text(CONFIG)
    simulation = ["-n", str(FRAMES), "-w", "2", "-c", "vlp_16", "--view", "camera", "--val-share", "0.2"]
    training = ["train", str(config), "-d", str(data), "--devices", "1"]
    for arguments in (["simulate", str(data), *simulation], [*training, "-o", str(run)]):
        console.print(f"asca {arguments[0]} for what follows")
        _finish(arguments)
    scans = ["--scans", str(KittiSplit(data).folder / "velodyne")]
    return [
        Job(
            "simulate",
            lambda out: ["simulate", str(out), *simulation],
            lambda out: list(out.glob("training/*/*.*")),
            _hashes,
        ),
        Job(
            "prepare",
            lambda out: ["prepare", str(config), "-d", str(data), "-s", f"data.prepared={out}", "-w", "2"],
            lambda out: [path for path in out.rglob("*") if path.is_file()],
            _hashes,
        ),
        Job(
            "train",
            lambda out: [*training, "-o", str(out)],
            lambda out: [out / "checkpoints" / "last.ckpt"],
            _weights,
        ),
        Job(
            "export",
            lambda out: ["export", str(run / "checkpoints" / "last.ckpt"), "-o", str(out), *scans],
            lambda out: list(out.parent.glob(f".{out.name}.asca-*/*")),
            _hashes,
        ),
    ]


def _kill(job: Job, folder: Path, kills: int, rng: random.Random, console: Console) -> list[Kill]:
    folder.mkdir()
    reference = _reference(job, folder)
    console.print(f"asca {job.name}: {reference.writes} writes seen in {reference.seconds:.1f} s")
    done: list[Kill] = []
    while len(done) < kills:
        out = folder / "out"
        if job.name == "export" and rng.random() < 0.5:
            shutil.copytree(folder / "reference", out)  # a bundle that is replaced
        share = _killed(job, out, reference, rng)
        if share is not None:
            _finish(job.arguments(out))
            left = tuple(path.name for path in folder.rglob("*") if _LEFTOVER.search(path.name))
            done.append(Kill(share, job.contents(out) == reference.contents, left))
            console.print(f"asca {job.name}: killed at {share:.0%}: {done[-1]}")
        shutil.rmtree(folder / "out")
    return done


def _reference(job: Job, folder: Path) -> Reference:
    out = folder / "reference"
    process, seen, times = _start(job.arguments(out)), set[tuple[Path, int]](), [time.perf_counter()]
    while process.poll() is None:
        before = len(seen)
        seen |= _seen(job, out)
        if len(seen) > before:
            times.append(time.perf_counter())
        time.sleep(POLL_S)
    _check(process, job.arguments(out))
    return Reference(len(seen), times[-1] - times[1], job.contents(out))


def _killed(job: Job, out: Path, reference: Reference, rng: random.Random) -> float | None:
    """Start, and kill after a random number of writes and a random fraction of the time between two.

    Returns:
        The share of the writes that was done; None if all were, and the run was left to end.
    """
    wanted = rng.randint(1, max(1, reference.writes - 1))
    pause_s = rng.random() * reference.seconds / reference.writes
    before = _seen(job, out)
    process, seen = _start(job.arguments(out)), set[tuple[Path, int]]()
    while process.poll() is None and len(seen) < wanted:
        seen |= _seen(job, out) - before
        time.sleep(POLL_S)
    time.sleep(pause_s)
    seen |= _seen(job, out) - before
    if process.poll() is not None or len(seen) >= reference.writes:
        process.wait()
        _check(process, job.arguments(out))
        return None
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    return len(seen) / reference.writes


def _seen(job: Job, out: Path) -> set[tuple[Path, int]]:
    """The watched files that are there, each with the time of its last write."""
    found = set()
    for path in job.watched(out):
        if _LEFTOVER.search(path.name):
            continue
        try:
            found.add((path.relative_to(out.parent), path.stat().st_mtime_ns))
        except FileNotFoundError:  # a temporary name that is gone already
            continue
    return found


def _start(arguments: list[str]) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "asca_pillars.cli", *arguments]
    # A group of its own, so that its workers are killed with it.
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True)


def _finish(arguments: list[str]) -> None:
    process = _start(arguments)
    process.wait()
    _check(process, arguments)


def _check(process: subprocess.Popen[bytes], arguments: list[str]) -> None:
    if process.returncode:
        assert process.stderr is not None, "it is piped"
        raise RuntimeError(f"asca {' '.join(arguments)} failed: {process.stderr.read().decode()[-2000:]}")


def _hashes(out: Path) -> dict[str, str]:
    """SHA-256 of every file."""
    files = (path for path in sorted(out.rglob("*")) if path.is_file())
    return {str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def _weights(out: Path) -> dict[str, str]:
    """SHA-256 of every tensor of last.ckpt, and the names of all files but TensorBoard's, which has one per start."""
    from asca_pillars.models.checkpoint import load_checkpoint

    loaded = load_checkpoint(out / "checkpoints" / "last.ckpt")
    state = loaded.detector.state_dict()
    hashes = {name: hashlib.sha256(value.numpy().tobytes()).hexdigest() for name, value in state.items()}
    names = [path for path in sorted(out.rglob("*")) if path.is_file() and "tensorboard" not in path.parts]
    return hashes | {"steps": str(loaded.steps), "files": " ".join(str(path.relative_to(out)) for path in names)}


if __name__ == "__main__":
    run_command(main)
