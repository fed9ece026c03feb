"""The runs of an ablation, trained and evaluated on equal terms, and the tables of their results.

Every run is `asca train` with one base configuration and a few overrides, in a process of its own; finished runs are
kept, so that an interrupted ablation can be resumed.
"""

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from asca_pillars.ablation.variants import Family, Row
from asca_pillars.base.errors import TrainingError
from asca_pillars.base.files import write_json
from asca_pillars.base.own_files import require_no_link, written_by
from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.base.system import default_threads
from asca_pillars.evaluation.kitti.average_precision import CLASS_NAMES, DIFFICULTIES
from asca_pillars.evaluation.report_page import markdown_table


@dataclass(frozen=True)
class Run:
    """One training: a variant with a seed, in a folder of its own."""

    variant: Row
    seed: int
    folder: Path

    @property
    def checkpoint(self) -> Path:
        """Last checkpoint of the training."""
        return self.folder / "checkpoints" / "last.ckpt"

    @property
    def trained(self) -> Path:
        """File with the duration of the training, written at its end."""
        return self.folder / "trained.json"

    @property
    def evaluated(self) -> Path:
        """Report of `asca eval`."""
        return self.folder / "evaluation" / "report.json"


def runs(out: str | Path, seeds: Sequence[int], variants: Sequence[Row]) -> list[Run]:
    """Return every run, all variants of the first seed before those of the next."""
    return [Run(variant, seed, Path(out) / variant.name / f"seed{seed}") for seed in seeds for variant in variants]


def finish_runs(
    todo: Sequence[Run],
    config: str,
    data: str | Path,
    split: str,
    jobs: int,
    overrides: Sequence[str] = (),
    init: Path | None = None,
    *,
    reporter: Reporter = SILENT,
) -> None:
    """Train and evaluate what is not yet, `jobs` processes at a time that share the cores.

    A run is evaluated as soon as it is trained, so that an interrupted ablation has rows to look at.

    Args:
        split: list of the data to evaluate on.
        overrides: of every run, in the form of `asca train -s`; those of the variant win over them.
        init: weights that every run starts from, see `asca train --init`.
        reporter: for the progress.

    Raises:
        TrainingError: a training or an evaluation failed; the message names its log.
    """
    threads = max(1, default_threads() // jobs)

    def finish(run: Run) -> None:
        if not run.trained.exists():
            settings = (*overrides, *run.variant.overrides, f"train.seed={run.seed}")
            start = () if init is None else ("--init", str(init))
            where = ("--data", str(data), "--out", str(run.folder), "--devices", "1", *start)
            chosen = [part for text in settings for part in ("-s", text)]
            with _record_seconds(run.folder / "training_seconds.json") as seconds:
                _run_command(run, ("train", config, *where, *chosen), threads)
            write_json(run.trained, {"seconds": round(sum(seconds)), "threads": threads})
        report = run.evaluated.parent
        where = ("--data", str(data), "--split", split, "--out", str(report))
        _run_command(run, ("eval", str(run.checkpoint), *where, "--gallery", "0", "--provider", "auto"), threads)

    waiting = [run for run in todo if not (run.trained.exists() and run.evaluated.exists())]
    _run_in_threads(waiting, finish, jobs, reporter)


def _run_in_threads(todo: Sequence[Run], work: Callable[[Run], None], jobs: int, reporter: Reporter) -> None:
    with ThreadPoolExecutor(jobs) as pool:
        waiting = [pool.submit(work, run) for run in todo]
        try:
            for future in reporter.track(waiting, "Training and evaluating"):
                future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


@contextmanager
def _record_seconds(path: Path) -> Iterator[list[float]]:
    """Time the block: yield the seconds of every attempt, to which its own are appended; kept in a file.

    An attempt that was killed together with this process is not among them.
    """
    attempts: list[float] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
    start = time.monotonic()
    try:
        yield attempts
    finally:
        attempts.append(time.monotonic() - start)
        write_json(path, attempts)


def _run_command(run: Run, arguments: Sequence[str], threads: int) -> None:
    """Run one command as a user would, its output in the run's folder."""
    run.folder.mkdir(parents=True, exist_ok=True)
    log = run.folder / f"{arguments[0]}.log"
    require_no_link(log)
    with log.open("a", encoding="utf-8") as file:
        if not file.tell():
            file.write(f"{written_by('asca ablate')}\n")
            file.flush()
        done = subprocess.run(
            [sys.executable, "-m", "asca_pillars.cli", *arguments],
            stdout=file,
            stderr=subprocess.STDOUT,
            # One thread count for every run: sums of floats depend on it, and so do the weights.
            env=os.environ | {"OMP_NUM_THREADS": str(threads)},
            check=False,
        )
    if done.returncode:
        words = log.read_text(encoding="utf-8").split("\n")
        reason = next((line for line in reversed(words) if line.strip()), "it said nothing")
        name = f"{run.variant.name}, seed {run.seed}"
        raise TrainingError(f"{log}: `asca {arguments[0]}` of {name} failed: {reason.removeprefix('asca: ')}")


BANDS_M = ((0.0, 40.0), (40.0, 80.0))


@dataclass(frozen=True)
class Speed:
    """The exported detector on a CPU: frames per second (median), time against the baseline's with its quartiles."""

    fps: float
    ratio: float
    ratio_quartiles: tuple[float, float]
    parameters: int


def tables(family: Family, results: Mapping[str, Sequence[dict[str, Any]]], speeds: Mapping[str, Speed]) -> str:
    """Return Markdown of every table whose variants have results.

    Args:
        family: of the variants.
        results: what `asca eval --json` wrote, one per seed, by name of the variant.
        speeds: of the variants that were exported.
    """
    parts = []
    for title, names in family.tables.items():
        trained = [name for name in names if results.get(name)]
        if trained:
            parts += [
                f"### {title}\n",
                _summary(family, trained, results, speeds),
                _by_difficulty(family, trained, results),
            ]
    return "\n".join(parts)


def read_results(runs: Iterable[Run]) -> dict[str, list[dict[str, Any]]]:
    """Return the evaluations that are there, one per seed, by name of the variant."""
    results: dict[str, list[dict[str, Any]]] = {}
    for run in runs:
        if run.evaluated.exists():
            results.setdefault(run.variant.name, []).append(json.loads(run.evaluated.read_text(encoding="utf-8")))
    return results


def _summary(
    family: Family,
    names: Sequence[str],
    results: Mapping[str, Sequence[dict[str, Any]]],
    speeds: Mapping[str, Speed],
) -> str:
    bands = [f"{low:g}-{high:g} m" for low, high in BANDS_M]
    header = [*family.components, *CLASS_NAMES, "mean", *bands, "parameters", "FPS", "time / baseline"]
    rows = []
    for name in names:
        runs, speed = results[name], speeds.get(name)
        cells = [_spread([_ap(run, c, "moderate") for run in runs]) for c in CLASS_NAMES]
        cells.append(_spread([_mean_ap(run) for run in runs]))
        cells += [_spread([_band(run, *band) for run in runs]) for band in BANDS_M]
        if speed is None:
            cells += ["-"] * 3
        else:
            low, high = speed.ratio_quartiles
            cells += [f"{speed.parameters:,}", f"{speed.fps:.1f}", f"{speed.ratio:.2f} ({low:.2f}-{high:.2f})"]
        rows.append([*family.variants[name].components, *cells])
    return markdown_table(header, rows, left=len(family.components))


def _by_difficulty(family: Family, names: Sequence[str], results: Mapping[str, Sequence[dict[str, Any]]]) -> str:
    header = [*family.components, *(f"{c} {d}" for c in CLASS_NAMES for d in DIFFICULTIES)]
    rows = []
    for name in names:
        cells = [_spread([_ap(run, c, d) for run in results[name]]) for c in CLASS_NAMES for d in DIFFICULTIES]
        rows.append([*family.variants[name].components, *cells])
    return markdown_table(header, rows, left=len(family.components))


def _ap(result: dict[str, Any], class_name: str, difficulty: str) -> float:
    """Return the 3D AP R40 in percent; 0 for a class without detections."""
    class_result = result["results"][class_name]
    values = class_result and class_result["3d"]
    return float(values["R40"][DIFFICULTIES.index(difficulty)]) if values else 0.0


def _band(result: dict[str, Any], low_m: float, high_m: float) -> float:
    band = next(b for b in result["bands"] if (b["low_m"], b["high_m"]) == (low_m, high_m))
    return _mean_ap(band)


def _mean_ap(result: dict[str, Any]) -> float:
    return statistics.fmean(_ap(result, class_name, "moderate") for class_name in CLASS_NAMES)


def _spread(values: Sequence[float]) -> str:
    """Return the mean over the seeds, and half the distance between the best and the worst."""
    mean = f"{statistics.fmean(values):.2f}"
    return mean if len(values) == 1 else f"{mean} ± {(max(values) - min(values)) / 2:.2f}"
