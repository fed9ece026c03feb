"""Markdown tables of an ablation: training, results, spread over the seeds."""

import json
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from asca_pillars.ablation.ablation_runs import Run
from asca_pillars.ablation.variants import Family
from asca_pillars.evaluation.kitti.average_precision import CLASS_NAMES, DIFFICULTIES
from asca_pillars.evaluation.report_page import markdown_table

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
        there = [name for name in names if results.get(name)]
        if there:
            parts += [
                f"### {title}\n",
                _summary(family, there, results, speeds),
                _by_difficulty(family, there, results),
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
    found = result["results"][class_name]
    values = found and found["3d"]
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
