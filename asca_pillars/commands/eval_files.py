"""What `asca eval` writes, whatever the protocol: a page of tables, its JSON, and the predictions of its own run."""

from pathlib import Path
from typing import Any

from rich.console import Console

from asca_pillars.commands.writable_file import require_writable
from asca_pillars.evaluation import gallery
from asca_pillars.evaluation.errors.error_report import remove_errors
from asca_pillars.evaluation.report_page import ReportPage
from asca_pillars.files import atomic_path, remove_directory, require_own, require_replaceable, write_json

COMMAND, MADE_BY = "asca eval", "made_by.json"  # the file marks a folder of predictions as ours to replace


def claim(out: Path, json_path: Path | None) -> None:
    """Make sure that nothing but earlier evaluations is in `out`, and that `json_path` can be written.

    Raises:
        OutputError, OSError: not so; names what is there.
    """
    reports = "report.json", "waymo.json", "iou.json", "distance.json", "tracking.json"
    require_own(out, COMMAND, *reports, f"predictions/{MADE_BY}", text='"')
    for folder, marker in (("predictions", MADE_BY), ("gallery", gallery.INDEX)):
        require_replaceable(out / folder, COMMAND, marker)
    require_writable(json_path)


def write_report(
    name: str,
    page: ReportPage,
    content: dict[str, Any],
    out: Path,
    json_path: Path | None,
    scored: Path,
    console: Console,
) -> None:
    """Print a report; write `name`.json and `name`.md below `out`, and the JSON to `json_path`, too.

    An earlier evaluation's analysis of errors is removed.

    Args:
        name: of the files.
        page: what is printed and written as Markdown.
        content: what is written as JSON.
        out: of the evaluation, see `claim`.
        json_path: None for no other copy.
        scored: the predictions that it is about; those that an earlier evaluation left in `out` are removed.
        console: to print on.

    Raises:
        OutputError, OSError: something cannot be written or removed.
    """
    page.print(console)
    _remove_predictions_of_another(out, scored)
    remove_errors(out)
    write_json(out / f"{name}.json", content)
    with atomic_path(out / f"{name}.md") as temporary:
        temporary.write_text(page.markdown(), encoding="utf-8")
    if json_path is not None:
        write_json(json_path, content)


def _remove_predictions_of_another(out: Path, scored: Path) -> None:
    own = (out / "predictions").resolve()
    if own not in (scored.resolve(), *scored.resolve().parents):
        remove_directory(own, COMMAND, MADE_BY)
