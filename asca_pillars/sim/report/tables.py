"""The comparison as text: on the console, as Markdown and as JSON."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from math import isfinite
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from asca_pillars.base.files import write_json, write_text
from asca_pillars.base.own_files import page_end
from asca_pillars.base.schema import to_dict
from asca_pillars.evaluation.report_page import markdown_table
from asca_pillars.sim.report.comparison import Comparison, Row
from asca_pillars.sim.report.reference import CAR_FIT_RANGE_M, NEAR_CARS_M, Fit
from asca_pillars.sim.report.scan_statistics import OBJECTS

_COLUMNS = ("", "KITTI", "this set", "ratio\nor JS", "bar", "kept", "by\nchance")
_LEFT = 1
PAGE_END = page_end("asca simulate")
_BARS = {"ratio": "1+-{:g}", "difference": "+-{:.2f}", "distance": "< {:g}"}
_MEASURES = {"ratio": "x {:.2f}", "difference": "{:+.2f}", "distance": "JS {:.3f}"}


def print_comparison(comparison: Comparison, console: Console) -> None:
    """Print the rows with a tolerance, and notes on missing rows, on the console."""
    console.print(title(comparison), style="bold", highlight=False, soft_wrap=True)
    table = Table(box=box.SIMPLE, padding=(0, 1, 0, 0))
    for index, column in enumerate(_COLUMNS):
        table.add_column(column, justify="left" if index < _LEFT else "right")
    group = None
    for row in comparison.rows:
        if row.bar is None:
            continue
        if group not in (None, row.group):
            table.add_section()
        group = row.group
        name, *cells = _cells(row)
        table.add_row(name, *cells, style="yellow" if row.within is False else None)
    console.print(table)
    for line in notes(comparison):
        console.print(line, highlight=False, soft_wrap=True)


def title(comparison: Comparison) -> str:
    """Return the title of the report: the compared sets."""
    simulated, scan = comparison.simulated, comparison.simulated.scan
    return f"{simulated.source}: {scan.scans} scans and the labels of {simulated.frames} frames, beside KITTI"


def notes(comparison: Comparison) -> list[str]:
    """Return notes: rows within tolerance, parts left out, and the meaning of the distances."""
    barred = [row for row in comparison.rows if row.within is not None]
    missed = "; ".join(row.name for row in comparison.missed)
    noisy = "; ".join(row.name for row in comparison.missed if row.within_noise)
    return [
        f"{len(barred) - len(comparison.missed)} of {len(barred)} bars kept"
        + (f"; missed: {missed}" if missed else ""),
        *([f"Missed, but no farther off than chance: {noisy}"] if noisy else []),
        *(f"Left out: {line}" for line in comparison.skipped),
        "JS: Jensen-Shannon distance (base 2: 0 alike, 1 disjoint); of reflectances over 21 bins, exactly 0 and 20 of "
        "0.05, beside their means.",
        "Points of a car: a power law through the unoccluded, untruncated ones from {:.0f} to {:.0f} m; near ones up "
        "to {:.0f} m, because single returns far away turn the line.".format(*CAR_FIT_RANGE_M, NEAR_CARS_M[1]),
        "By chance: the standard error of a ratio; the JS distance to expect of a sample as small as the real "
        f"reflectances ({_sizes(comparison)}), or of labels as few as those of this set.",
        f"Real: {comparison.real.source}.",
    ]


def write_report(folder: Path, comparison: Comparison, plots: Sequence[str]) -> None:
    """Write report.md, which shows the named `plots` in the same folder, and report.json."""
    write_text(folder / "report.md", to_markdown(comparison, plots) + PAGE_END)
    write_json(folder / "report.json", to_json(comparison))


def to_markdown(comparison: Comparison, plots: Sequence[str]) -> str:
    """Return all rows as Markdown, a table for each group, and the named pictures."""
    parts = [f"# {title(comparison)}\n", "\n".join([*(f"- {line}" for line in notes(comparison)), ""])]
    columns = [column.replace("\n", " ") for column in _COLUMNS]
    for group in dict.fromkeys(row.group for row in comparison.rows):
        rows = [_cells(row) for row in comparison.rows if row.group == group]
        parts.append(f"## {group[0].upper()}{group[1:]}\n\n{markdown_table(columns, rows, _LEFT)}")
    real, simulated = comparison.real.label_fit, comparison.simulated.label_fit
    if simulated:
        combined = {name: real.get(name, ()) + simulated.get(name, ()) for name in dict.fromkeys([*real, *simulated])}
        parts.append(f"## The same by drive\n\n{fits_table(combined)}")
    parts += [f"![{name.removesuffix('.png').replace('_', ' ')}]({name})\n" for name in plots]
    return "\n".join(parts)


def fits_table(fits: Mapping[str, Sequence[Fit]]) -> str:
    """Return medians of the fit of labels to points, a column for each drive or folder, with the numbers of objects."""
    sources = list(dict.fromkeys(fit.source for of in fits.values() for fit in of))
    rows = []
    for name, of in fits.items():
        known = {fit.source: fit for fit in of}
        cells = [f"{fit.middle:+.2f} ({fit.objects})" if (fit := known.get(source)) else "" for source in sources]
        rows.append((name, *cells))
    return markdown_table(["", *sources], rows, _LEFT)


def to_json(comparison: Comparison) -> dict[str, Any]:
    """Return the rows, notes on missing rows, and the statistics of both sides."""
    return {
        "rows": [_plain(row) for row in comparison.rows],
        "skipped": list(comparison.skipped),
        "simulated": to_dict(comparison.simulated),
        "real": to_dict(comparison.real),
    }


def _sizes(comparison: Comparison) -> str:
    real = comparison.real.scan
    objects = [f"{real.reflectance[name].units} {name}s" for name in OBJECTS if name in real.reflectance]
    return f"{real.scans} scans, {', '.join(objects)}"


def _plain(row: Row) -> dict[str, Any]:
    values = asdict(row) | {"within": row.within}
    return values | {"value": row.value if isfinite(row.value) else None}


def _cells(row: Row) -> tuple[str, ...]:
    bar = "" if row.bar is None else _BARS[row.measure].format(row.bar)
    within = {None: "", True: "yes", False: "NO"}[row.within]
    noise = "" if row.noise is None else f"{row.noise:.3f}" if row.measure == "distance" else f"+-{row.noise:.2f}"
    value = _MEASURES[row.measure].format(row.value) if isfinite(row.value) else ""  # no ratio of 0 / 0
    return row.name, _number(row.real), _number(row.simulated), value, bar, within, noise


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.1f}" if abs(value) >= 10 else f"{value:.3f}"
