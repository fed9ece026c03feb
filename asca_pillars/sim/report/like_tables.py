"""Comparison of matched objects as text and as a picture."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from asca_pillars.base.files import write_json, write_text
from asca_pillars.evaluation.report_page import markdown_table
from asca_pillars.sim.report.like_for_like import (
    ALL,
    FIRING_SCORE,
    KINDS,
    MEASURES,
    NEIGHBORS,
    FiringRow,
    LikeForLike,
    LikeRow,
)
from asca_pillars.sim.report.plots import new_figure, save_figure
from asca_pillars.sim.report.reference import CLASSES
from asca_pillars.sim.report.tables import PAGE_END

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLUMNS = ("", "measure", "objects", "real", "alike", "ratio", "95 %", "percentile")
_FIRING = ("unlabelled clusters", "real per frame", "fire", "simulated per frame", "fire")
_LEFT, _FIRING_LEFT = 2, 1
_COLORS = {"Car": "#0072B2", "Pedestrian": "#D55E00", "Cyclist": "#009E73", ALL: "#444444"}
PICTURE = "like_for_like.png"


def print_like(result: LikeForLike, console: Console) -> None:
    """Print both tables on the console."""
    console.print(title(result), style="bold", highlight=False, soft_wrap=True)
    for columns, rows, left in _tables(result):
        table = Table(box=box.SIMPLE, padding=(0, 1, 0, 0))
        for index, column in enumerate(columns):
            table.add_column(column, justify="left" if index < left else "right")
        for cells in rows:
            table.add_row(*cells)
        console.print(table)
    for line in notes(result):
        console.print(line, highlight=False, soft_wrap=True)


def title(result: LikeForLike) -> str:
    """Return the title of the report: the two compared sets."""
    return (
        f"{result.simulated.source} ({result.simulated.frames} frames) beside objects of {result.real.source} "
        f"({result.real.frames} frames), like with like"
    )


def notes(result: LikeForLike) -> list[str]:
    """Return notes on the tables."""
    lines = [
        f"Each real object is compared with the {NEIGHBORS} simulated ones of its class that are nearest to it in "
        "distance, angle of view and occlusion (for scores, in points, too); of points and pillars geometric means.",
        "Percentile: of the real object among them, mean and standard error; 0.5 means no gap.",
    ]
    if result.firing is not None:
        lines.append(f"Scores and firing (a person or cyclist of {FIRING_SCORE:g} or more): {result.detector}.")
    return lines


def write_like(folder: Path, result: LikeForLike) -> None:
    """Write like_for_like.md, .json and .png."""
    write_json(folder / "like_for_like.json", result.to_json())
    _draw(folder / PICTURE, result)
    parts = [f"# {title(result)}\n", "\n".join([*(f"- {line}" for line in notes(result)), ""])]
    parts += [markdown_table(columns, rows, left) for columns, rows, left in _tables(result)]
    parts.append(f"![percentiles]({PICTURE})\n")
    write_text(folder / "like_for_like.md", "\n".join(parts) + PAGE_END)


def _tables(result: LikeForLike) -> list[tuple[tuple[str, ...], list[tuple[str, ...]], int]]:
    tables: list[tuple[tuple[str, ...], list[tuple[str, ...]], int]]
    tables = [(_COLUMNS, [_like_cells(row) for row in result.rows], _LEFT)]
    if result.firing is not None:
        pairs = [_firing_cells(*pair) for pair in zip(*result.firing, strict=True)]
        tables.append((_FIRING, pairs, _FIRING_LEFT))
    return tables


def _like_cells(row: LikeRow) -> tuple[str, ...]:
    low, high = row.ratio_interval
    interval = f"{low:.2f} to {high:.2f}" if np.isfinite([low, high]).all() else ""
    ratio = f"{row.ratio:.2f}" if np.isfinite(row.ratio) else ""
    percentile = f"{row.percentile:.2f} +-{row.percentile_error:.2f}"
    values = (f"{value:.0f}" if value >= 20 else f"{value:.3f}" for value in (row.real, row.simulated))
    return (row.class_name, MEASURES[row.measure], str(row.objects), *values, ratio, interval, percentile)


def _firing_cells(real: FiringRow, simulated: FiringRow) -> tuple[str, ...]:
    def share(row: FiringRow) -> str:
        return f"{100 * row.share:.1f} +-{100 * row.error:.1f} %" if row.clusters else ""

    return (
        KINDS[real.kind],
        f"{real.per_frame:.2f}",
        share(real),
        f"{simulated.per_frame:.2f}",
        share(simulated),
    )


def _draw(path: Path, result: LikeForLike) -> None:
    """Draw the percentiles of each measure by class, and the detection rates of clusters, if known."""
    figure, axes = new_figure(1, 1 if result.firing is None else 2, 6.5, 5.0)
    _draw_percentiles(axes[0], result)
    if result.firing is not None:
        at = np.arange(len(KINDS))
        for offset, name, rows, color in zip(
            (-0.2, 0.2), ("real", "simulated"), result.firing, ("#0072B2", "#D55E00"), strict=True
        ):
            shares = [100 * row.share if row.clusters else 0.0 for row in rows]
            errors = [100 * row.error if row.clusters else 0.0 for row in rows]
            axes[1].bar(at + offset, shares, 0.36, yerr=errors, color=color, label=name, capsize=3)
        axes[1].set_xticks(at, [text.replace(" (", "\n(") for text in KINDS.values()], fontsize=7)
        axes[1].set_ylabel(f"% that fire (person or cyclist >= {FIRING_SCORE:g})")
        axes[1].set_title("Unlabelled clusters", fontsize=10)
        axes[1].set_ylim(bottom=0)
        axes[1].legend(fontsize=8)
    save_figure(path, figure)


def _draw_percentiles(plot: "Axes", result: LikeForLike) -> None:
    names = list(MEASURES)
    for step, name in enumerate((*CLASSES, ALL)):
        rows = [row for row in result.rows if row.class_name == name]
        at = [len(names) - 1 - names.index(row.measure) + 0.15 * (1.5 - step) for row in rows]
        values, errors = [row.percentile for row in rows], [2 * row.percentile_error for row in rows]
        if rows:
            label = f"{name} ({rows[0].objects})"
            plot.errorbar(values, at, xerr=errors, fmt="o", color=_COLORS[name], label=label, markersize=5)
    plot.axvline(0.5, color="#999999", linewidth=1)
    plot.set_yticks(range(len(names)), [MEASURES[name] for name in reversed(names)], fontsize=8)
    plot.set_xlim(0, 1)
    plot.set_xlabel("percentile of real objects among simulated look-alikes (bars: 2 standard errors)", fontsize=8)
    plot.set_title("Real objects beside simulated ones (0.5: no gap)", fontsize=10)
    plot.legend(fontsize=8)
