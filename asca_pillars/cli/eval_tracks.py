"""The steps of `asca eval --protocol tracking`: identities over time, from what `asca detect --track` wrote."""

from pathlib import Path

from rich.console import Console

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.system import describe_environment
from asca_pillars.cli.eval_files import claim, write_report
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.open_split import open_split
from asca_pillars.evaluation.report_page import ReportPage
from asca_pillars.evaluation.tracking.tracking_report import (
    tracking_json,
    tracking_notes,
    tracking_report,
    tracking_tables,
)


def evaluate_tracks(
    data: Path, split: str, predictions: Path, out: Path, json_path: Path | None, console: Console
) -> None:
    """Score tracks; print and write the table and the JSON.

    Raises:
        AscaError: a file cannot be read, or has no identities.
    """
    labels = open_split(data, split)
    if not isinstance(labels, BoxSplit):
        raise ConfigError(f"--protocol tracking: {data} has no identities; give sequences of asca simulate --sequences")
    claim("tracking", out, json_path, predictions, (data,))
    about = {"data": str(data), "split": split, "predictions": str(predictions), "environment": describe_environment()}
    report = tracking_report(labels, predictions, f"{predictions} against {data}, {split}", about)
    page = ReportPage(report.subject, tracking_tables(report), tracking_notes(report))
    write_report("tracking", page, tracking_json(report), out, json_path, predictions, console)
    console.print(f"Written to {out}/", highlight=False)
