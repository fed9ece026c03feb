"""The ablation: the paper's Table 5, zones and their map, readings of CPA, necks, matching, scores, on equal terms.

Every run is `asca train` with one base configuration and a few overrides, in a process of its own; finished runs are
kept, so that an interrupted ablation goes on where it stopped.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from rich.progress import track

from asca_pillars.errors import TrainingError
from asca_pillars.files import atomic_path
from asca_pillars.geometry.anchors import KITTI_CLASSES
from asca_pillars.pillar_config import PillarModel
from asca_pillars.schema import to_dict
from asca_pillars.system import default_threads

_SIZES = 5  # of a class, the first fields: name, sizes and height, which thresholds do not change


class Row(Protocol):
    """A variant: what it changes in the base configuration."""

    @property
    def name(self) -> str:
        """Of the variant."""

    @property
    def overrides(self) -> tuple[str, ...]:
        """For `asca train -s`."""

    @property
    def insert(self) -> str:
        """How objects are inserted, see `augment.insert.method`."""

    @property
    def components(self) -> tuple[str, ...]:
        """Cells of the table's first columns."""

    def misfit(self, model: Any) -> str | None:
        """Why the row would change more of a base's `model` than its cells say; None if it would not."""


class Family(NamedTuple):
    """The ablation of one family of detectors."""

    variants: Mapping[str, Row]
    """By name, the baseline first."""
    tables: Mapping[str, tuple[str, ...]]
    """Names of the rows of each table, by its title."""
    components: tuple[str, ...]
    """Heads of the columns that say what a row has."""


@dataclass(frozen=True)
class Variant:
    """One row of the pillar detectors' ablation."""

    name: str
    zones: int = 1
    cpa: str = "none"
    insert: str = "none"
    map: str = "warped"
    neck: str = "dense"
    active_cells: str = "fine"
    person_ious: tuple[float, float] | None = None
    """Overlap from which an anchor is positive and below which it is negative, of every class but cars; None for the
    base configuration's."""
    assigner: str | None = None
    """What matches anchors with boxes, see `model.loss`; None for the base configuration's."""
    score_target: str | None = None
    """What scores are to be, likewise."""

    @property
    def overrides(self) -> tuple[str, ...]:
        """For `asca train -s`. One zone means PointPillars' pillars of 0.16 m, several start at the paper's 0.32 m."""
        return (
            f"model.spec.grid.map={self.map}",
            f"model.network.neck={self.neck}",
            f"model.network.active_cells={self.active_cells}",
            *self._learnt,
            f"model.spec.grid.zones={self.zones}",
            f"model.spec.grid.v_max_m={0.16 if self.zones == 1 else 0.32}",
            f"model.network.cpa={self.cpa}",
            f"augment.insert.method={self.insert}",
        )

    @property
    def components(self) -> tuple[str, ...]:
        """Cells of the table's first columns, see `PILLARS`."""
        zones = f"K={self.zones}" if self.zones > 1 else "-"
        if self.map != "warped":
            zones += f" {self.map}"
        cpa = "-" if self.cpa == "none" else self.cpa
        neck = "-" if self.neck == "dense" else self.active_cells
        insert = {"none": "-", "gt_aug": "GT-Aug", "rs_aug": "RS-Aug"}[self.insert]
        matching = self.assigner or "-"
        if self.person_ious is not None:
            matching = " / ".join(f"{iou:g}" for iou in self.person_ious)
        return zones, cpa, insert, neck, matching, self.score_target or "-"

    def misfit(self, model: PillarModel) -> str | None:
        """Rows with other thresholds state all classes."""
        sizes = [[astuple(one)[:_SIZES] for one in classes] for classes in (KITTI_CLASSES, model.spec.classes)]
        return "states KITTI's classes" if self.person_ious is not None and sizes[0] != sizes[1] else None

    @property
    def _learnt(self) -> tuple[str, ...]:
        """Which anchors learn, and what."""
        choices = {"assigner": self.assigner, "score_target": self.score_target}
        chosen = tuple(f"model.loss.{name}={choice}" for name, choice in choices.items() if choice is not None)
        if self.person_ious is None:
            return chosen
        positive, negative = self.person_ious
        classes = [
            spec if spec.name == "Car" else replace(spec, positive_iou=positive, negative_iou=negative)
            for spec in KITTI_CLASSES
        ]
        return (*chosen, f"model.spec.classes={json.dumps([to_dict(spec) for spec in classes])}")


VARIANTS = {
    variant.name: variant
    for variant in (
        Variant("baseline"),
        Variant("asp_k3", zones=3),
        Variant("cpa_channel", cpa="channel"),
        Variant("asp_k3_cpa_channel", zones=3, cpa="channel"),
        Variant("asp_k2", zones=2),
        Variant("asp_k4", zones=4),
        Variant("asp_k3_cpa_paper", zones=3, cpa="paper"),
        Variant("gt_aug", insert="gt_aug"),
        Variant("rs_aug", insert="rs_aug"),
        Variant("asp_k3_cpa_channel_rs_aug", zones=3, cpa="channel", insert="rs_aug"),
        Variant("asp_k3_cpa_point", zones=3, cpa="point"),
        Variant("asp_k3_pooled_cpa_channel", zones=3, cpa="channel", map="pooled"),
        Variant("cpa_channel_sub", cpa="channel", neck="sparse", active_cells="sub"),
        Variant("cpa_channel_fine", cpa="channel", neck="sparse"),
        Variant("asp_k3_cpa_channel_fine", zones=3, cpa="channel", neck="sparse"),
        Variant("asp_k3_pooled_cpa_channel_fine", zones=3, cpa="channel", map="pooled", neck="sparse"),
        Variant("cpa_channel_lower_ious", cpa="channel", person_ious=(0.35, 0.2)),
        Variant("cpa_channel_fine_lower_ious", cpa="channel", neck="sparse", person_ious=(0.35, 0.2)),
        Variant(
            "asp_k3_pooled_cpa_channel_fine_lower_ious",
            zones=3,
            cpa="channel",
            map="pooled",
            neck="sparse",
            person_ious=(0.35, 0.2),
        ),
        Variant("cpa_channel_fine_atss", cpa="channel", neck="sparse", assigner="atss"),
        Variant("cpa_channel_fine_iou_score", cpa="channel", neck="sparse", score_target="iou"),
        Variant("cpa_channel_fine_atss_iou_score", cpa="channel", neck="sparse", assigner="atss", score_target="iou"),
    )
}

PILLARS = Family(
    variants=VARIANTS,
    tables={
        "Components (the rows of the paper's Table 5)": (
            *("baseline", "gt_aug", "rs_aug", "asp_k3", "cpa_channel", "asp_k3_cpa_channel"),
            "asp_k3_cpa_channel_rs_aug",
        ),
        "Zones of the adaptive-scale pillars (K)": ("baseline", "asp_k2", "asp_k3", "asp_k4"),
        "Readings of the correlative point attention": (
            *("asp_k3", "asp_k3_cpa_paper", "asp_k3_cpa_channel", "asp_k3_cpa_point"),
        ),
        "Map and neck": (
            *("cpa_channel", "asp_k3_cpa_channel", "asp_k3_pooled_cpa_channel"),
            *("cpa_channel_sub", "cpa_channel_fine", "asp_k3_cpa_channel_fine", "asp_k3_pooled_cpa_channel_fine"),
            *("cpa_channel_fine_lower_ious", "asp_k3_pooled_cpa_channel_fine_lower_ious"),
        ),
        "Matching, and what scores are to be": (
            *("cpa_channel", "cpa_channel_lower_ious", "cpa_channel_fine", "cpa_channel_fine_lower_ious"),
            *("cpa_channel_fine_atss", "cpa_channel_fine_iou_score", "cpa_channel_fine_atss_iou_score"),
        ),
    },
    components=("ASP", "CPA", "Aug", "neck", "matching", "score"),
)


@dataclass(frozen=True)
class Run:
    """One training: a variant with a seed, in a folder of its own."""

    variant: Row
    seed: int
    folder: Path

    @property
    def checkpoint(self) -> Path:
        """The last one that training wrote."""
        return self.folder / "checkpoints" / "last.ckpt"

    @property
    def trained(self) -> Path:
        """Written when training has ended: how long it took."""
        return self.folder / "trained.json"

    @property
    def evaluated(self) -> Path:
        """The report of `asca eval`."""
        return self.folder / "evaluation" / "report.json"


def runs(out: str | Path, seeds: Sequence[int], variants: Sequence[Row]) -> list[Run]:
    """Every run, all variants of the first seed before those of the next."""
    return [Run(variant, seed, Path(out) / variant.name / f"seed{seed}") for seed in seeds for variant in variants]


def finish_runs(
    todo: Sequence[Run],
    config: str,
    data: str | Path,
    split: str,
    jobs: int,
    overrides: Sequence[str] = (),
    init: Path | None = None,
) -> None:
    """Train and evaluate what is not yet, `jobs` processes at a time that share the cores.

    A run is evaluated as soon as it is trained, so that an interrupted ablation has rows to look at.

    Args:
        split: list of the data to evaluate on.
        overrides: of every run, in the form of `asca train -s`; those of the variant win over them.
        init: weights that every run starts from, see `asca train --init`.

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
            seconds = _asca(run, ("train", config, *where, *chosen), threads)
            with atomic_path(run.trained) as temporary:
                temporary.write_text(json.dumps({"seconds": round(seconds), "threads": threads}), encoding="utf-8")
        report = run.evaluated.parent
        where = ("--data", str(data), "--split", split, "--out", str(report))
        _asca(run, ("eval", str(run.checkpoint), *where, "--gallery", "0", "--provider", "auto"), threads)

    _at_once([run for run in todo if not run.evaluated.exists()], finish, jobs)


def _at_once(todo: Sequence[Run], work: Callable[[Run], None], jobs: int) -> None:
    with ThreadPoolExecutor(jobs) as pool:
        waiting = [pool.submit(work, run) for run in todo]
        try:
            for future in track(waiting, "Training and evaluating", disable=not waiting):
                future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _asca(run: Run, arguments: Sequence[str], threads: int) -> float:
    """Run one command as a user would, its output in the run's folder; returns the seconds it took."""
    run.folder.mkdir(parents=True, exist_ok=True)
    log = run.folder / f"{arguments[0]}.log"
    start = time.monotonic()
    with log.open("a", encoding="utf-8") as file:
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
    return time.monotonic() - start
