"""Report of the error analysis: errors.json, errors.md and errors.html with sortable tables."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from asca_pillars.base.errors import ConfigError, DatasetError
from asca_pillars.base.files import write_json, write_text
from asca_pillars.base.own_files import Recognizer, ending_with, json_object, page_end, require_own_file
from asca_pillars.base.progress import Reporter
from asca_pillars.base.schema import parse, to_dict
from asca_pillars.base.strict import Strict
from asca_pillars.data.kitti.kitti_split import read_image_set
from asca_pillars.evaluation.errors.error_frames import ErrorFrames
from asca_pillars.evaluation.errors.error_summary import DatasetErrors, match_frames, summarize
from asca_pillars.evaluation.errors.error_tables import PRINTED_NOTES, error_notes, error_tables, group_tables
from asca_pillars.evaluation.errors.worst_cases import VIEW_TITLES, Case, CaseSection, draw_cases, worst_cases
from asca_pillars.evaluation.report_page import ReportPage, TextTable
from asca_pillars.scans.find_scans import visible_files

_STYLE = """
:root { color-scheme: light dark; --text: #1b1f24; --page: #fff; --soft: #59636e; --line: #d1d9e0; --pane: #f4f6f8;
  --far: #b3bcc6; --near: #1f5fbf; --bright: #d97706; --label: #12803c; --detection: #c2188b; }
@media (prefers-color-scheme: dark) { :root { --text: #e6edf3; --page: #0d1117; --soft: #9aa4af; --line: #30363d;
  --pane: #161b22; --far: #4a535d; --near: #79b8ff; --bright: #ffb454; --label: #56d364; --detection: #ff7ac6; } }
body { font: 14px/1.45 system-ui, sans-serif; margin: 1.5rem auto; max-width: 110rem; padding: 0 1rem;
  color: var(--text); background: var(--page); }
h2 { margin-top: 2.5rem; border-bottom: 1px solid var(--line); }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 12px; font-variant-numeric: tabular-nums; }
th, td { padding: .2rem .5rem; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
th.name, td.name { text-align: left; }
tr.first td { border-top: 2px solid var(--soft); }
summary { cursor: pointer; font-weight: 600; margin: 1rem 0; }
th button { all: unset; cursor: pointer; font-weight: 600; }
th button:focus-visible { outline: 2px solid var(--near); }
.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(34rem, 1fr)); gap: 1rem; }
a { color: var(--near); }
figure { margin: 0; }
figcaption, .notes, .legend { color: var(--soft); font-size: 12px; }
figcaption b { color: var(--text); }
svg { width: 100%; height: auto; }
svg svg { overflow: hidden; }
path, polygon { fill: none; stroke-linecap: round; }
.pane { fill: var(--pane); }
.far { stroke: var(--far); stroke-width: 6; }
.near { stroke: var(--near); stroke-width: 9; }
.bright { stroke: var(--bright); stroke-width: 11; }
.ground { stroke: var(--line); stroke-width: 2; }
.label { stroke: var(--label); stroke-width: 5; }
.detection { stroke: var(--detection); stroke-width: 5; }
.other { stroke-width: 2; stroke-dasharray: 10 8; }
.legend span { font-weight: 600; }
"""
_SCRIPT = """
const number = text => {
  const value = parseFloat(text.replace(/^[^0-9+-]*/, ''));
  return isNaN(value) ? -Infinity : value;
};
document.querySelectorAll('th button').forEach(button => button.addEventListener('click', () => {
  const cell = button.parentElement, table = cell.closest('table'), column = cell.cellIndex;
  const up = cell.getAttribute('aria-sort') === 'descending';
  table.querySelectorAll('th').forEach(one => one.removeAttribute('aria-sort'));
  cell.setAttribute('aria-sort', up ? 'ascending' : 'descending');
  const text = row => row.cells[column].textContent;
  const order = cell.className === 'name'
    ? (a, b) => text(a).localeCompare(text(b))
    : (a, b) => number(text(a)) - number(text(b));
  table.querySelectorAll('tr.first').forEach(row => row.classList.remove('first'));
  [...table.tBodies[0].rows].sort((a, b) => (up ? 1 : -1) * order(a, b)).forEach(row => table.tBodies[0].append(row));
}));
document.querySelector('#order').addEventListener('change', event => {
  const [key, sign] = event.target.value.split(' ');
  document.querySelectorAll('.grid').forEach(grid => [...grid.children]
    .sort((a, b) => Number(sign) * (a.dataset[key] - b.dataset[key])).forEach(one => grid.append(one)));
});
"""
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
_ORDERS = {
    "error -1": "worst first",
    "score -1": "highest score first",
    "distance 1": "nearest first",
    "points -1": "most points first",
    "frame 1": "by frame",
}


def error_page(
    title: str,
    tables: Sequence[TextTable],
    more: Sequence[TextTable],
    notes: Sequence[str],
    sections: Sequence[CaseSection],
) -> str:
    """Return the page as HTML.

    Args:
        title: subject of the evaluation.
        tables: printed tables.
        more: collapsed tables.
        notes: definitions.
        sections: cases with pictures (`worst_cases.draw_cases`).
    """
    names = dict.fromkeys(section.class_name for section in sections)
    links = " · ".join(f'<a href="#{_anchor(name)}">{escape(name)}</a>' for name in names)
    orders = "".join(f'<option value="{value}">{text}</option>' for value, text in _ORDERS.items())
    views = ", ".join(VIEW_TITLES)
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head><body>",
        f"<h1>{escape(title)}</h1><p>Pictures: {links}</p>",
        *map(_table, tables),
        "<details><summary>By distance, occlusion, points and neighbors</summary>",
        *map(_table, more),
        "</details>",
        f'<ul class="notes">{"".join(f"<li>{escape(note)}</li>" for note in notes)}</ul>',
        '<h2>Pictures</h2><p><label>Order <select id="order">',
        f"{orders}</select></label></p>",
        f'<p class="legend">Each place {views}, in one scale. Seen from above, the line of sight points up; '
        "from the side, away from the sensor is to the right. "
        '<span style="color:var(--label)">label</span>, <span style="color:var(--detection)">detection</span>, others '
        'dashed; <span style="color:var(--near)">points</span> in the box and, from the side and the sensor, at its '
        'depth; <span style="color:var(--bright)">bright ones</span> (reflectance of 0.5 or more).</p>',
    ]
    seen: set[str] = set()
    for section in sections:
        if section.class_name not in seen:
            seen.add(section.class_name)
            parts.append(f'<h2 id="{_anchor(section.class_name)}">{escape(section.class_name)}</h2>')
        figures = "".join(map(_figure, section.cases))
        parts.append(f'<h3>{escape(section.title)}</h3><div class="grid">{figures}</div>')
    return "\n".join([*parts, f"<script>{_SCRIPT}</script></body></html>", ""])


def _anchor(class_name: str) -> str:
    return f"class-{escape(class_name.replace(' ', '-'), quote=True)}"


def _table(table: TextTable) -> str:
    kinds = ["name" if column < table.left else "number" for column in range(len(table.columns))]
    head = "".join(
        f'<th class="{kind}" scope="col"><button>{escape(title)}</button></th>'
        for kind, title in zip(kinds, table.columns, strict=True)
    )
    before = ("", *(row[0] for row in table.rows[:-1]))
    first = [row[0] != name for row, name in zip(table.rows, before, strict=True)]
    body = "".join(
        f"<tr{' class=first' if starts else ''}>{_cells(kinds, row)}</tr>"
        for starts, row in zip(first, table.rows, strict=True)
    )
    return (
        f'<h3>{escape(table.title)}</h3><div class="wide"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def _cells(kinds: Sequence[str], row: Sequence[str]) -> str:
    return "".join(f'<td class="{kind}">{escape(cell)}</td>' for kind, cell in zip(kinds, row, strict=True))


def _figure(case: Case) -> str:
    data = f'data-error="{case.error:g}" data-score="{case.score:g}" data-distance="{case.distance_m:g}" '
    data += f'data-points="{case.points}" data-frame="{case.frame}"'
    score = f"score {case.score:.2f}, " if case.score else ""
    place = f"{score}{case.distance_m:.0f} m, {case.points} points"
    texts = "; ".join(map(escape, case.texts))
    return f"<figure {data}>{case.svg}<figcaption><b>{escape(case.frame_id)}</b> {place}; {texts}</figcaption></figure>"


JSON, MARKDOWN, PAGE = "errors.json", "errors.md", "errors.html"
_COMMAND = "asca eval"
_END = page_end(_COMMAND)
PRODUCTS: dict[str, Recognizer] = {
    JSON: json_object("subject", "datasets", "about"),
    MARKDOWN: ending_with(_END),
    PAGE: ending_with(_END),
}
"""Output files, and the recognizer of a run's own files."""
BY_LIST = "list"


@dataclass(frozen=True)
class ErrorReport(Strict):
    """Contents of errors.json.

    Attributes:
        subject: description of the model or folder and the data.
        datasets: the whole dataset, then its parts.
        about: model, command, machine and versions.
    """

    subject: str
    datasets: tuple[DatasetErrors, ...]
    about: dict[str, Any]


def read_report(path: Path) -> ErrorReport:
    """Read an errors.json.

    Raises:
        DatasetError: the file is missing, or not such a file.
        ConfigError: its content is of another version; names the key.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DatasetError(
            f"{path}: cannot be read ({error.strerror}); give an errors.json of asca eval --errors"
        ) from None
    except ValueError:
        content = None
    if not isinstance(content, dict):
        raise DatasetError(f"{path}: not an errors.json of asca eval --errors; give one")
    return parse(ErrorReport, content, str(path))


def parts_of(root: Path, split: str, frame_ids: Sequence[str], by: str) -> dict[str, list[str]]:
    """Divide frames into parts, which are rows of the tables in addition to the whole.

    Args:
        root: folder of the dataset.
        split: name of the evaluated list.
        frame_ids: frame ids of the list.
        by: BY_LIST for the other lists of ImageSets/ that lie within the frames; or an integer, for parts by that
            number of first characters of the frame ids.

    Raises:
        ConfigError: `by` is neither, or gives no part.
        DatasetError: a list cannot be read.
    """
    known = set(frame_ids)
    if by == BY_LIST:
        names = [path.stem for path in visible_files(root / "ImageSets", "*.txt") if path.stem != split]
        lists = {name: read_image_set(root, name) for name in names}
        parts = {name: sorted(ids) for name, ids in sorted(lists.items()) if ids < known}
        if not parts:
            raise ConfigError(
                f"--errors-by {by}: no other list of {root / 'ImageSets'} lies within {split}; write one for each part"
            )
        return parts
    if not by.isdecimal() or int(by) < 1:
        raise ConfigError(f"--errors-by {by}: give {BY_LIST}, or how many characters of the frame ids name a part")
    grouped: dict[str, list[str]] = {}
    for frame_id in sorted(frame_ids):
        grouped.setdefault(frame_id[: int(by)], []).append(frame_id)
    if len(grouped) < 2:
        raise ConfigError(f"--errors-by {by}: every frame id begins with {next(iter(grouped))}; give a larger number")
    return grouped


def write_errors(
    frames: ErrorFrames,
    scores: Mapping[str, float],
    *,
    subject: str,
    name: str,
    parts: Mapping[str, Sequence[str]],
    beside: Sequence[ErrorReport],
    about: dict[str, Any],
    out: Path,
    reporter: Reporter,
) -> ReportPage:
    """Analyze the errors of an evaluation; write JSON, Markdown and page below `out`, and return the main table.

    Args:
        frames: labels and predictions.
        scores: score threshold of each class to evaluate.
        subject: description of the evaluated model and data.
        name: name of the dataset in the tables.
        parts: frame ids of each part, by its name.
        beside: reports of other evaluations, whose datasets are shown in the same tables.
        about: contents for the JSON.
        out: output folder of the evaluation.
        reporter: for the progress.

    Raises:
        DatasetError, ScanError: a frame cannot be read.
        OutputError, OSError: a file cannot be written.
    """
    matches = match_frames(frames, scores, reporter=reporter)
    dataset_errors = summarize(matches, name, parts, reporter=reporter)
    datasets = [*dataset_errors, *(data for report in beside for data in report.datasets)]
    sections = worst_cases(matches)
    pictured = draw_cases(frames, matches, sections, reporter=reporter)
    notes, tables, more = error_notes(datasets), error_tables(datasets), group_tables(datasets)
    title = f"{subject}: errors"
    page = ReportPage(title, tables, notes[:PRINTED_NOTES])
    write_json(out / JSON, to_dict(ErrorReport(subject, tuple(dataset_errors), about)))
    write_text(out / MARKDOWN, ReportPage(title, [*tables, *more], notes).markdown() + _END)
    write_text(out / PAGE, error_page(title, tables, more, notes, pictured) + _END)
    return page


def remove_errors(out: Path) -> None:
    """Remove the report that an earlier evaluation left.

    Raises:
        OutputError: something else has one of its names.
    """
    for name, is_own in PRODUCTS.items():
        require_own_file(out / name, _COMMAND, is_own)
        (out / name).unlink(missing_ok=True)
