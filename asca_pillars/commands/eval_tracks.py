"""The steps of `asca eval --protocol tracking`: identities over time, from what `asca detect --track` wrote."""

from pathlib import Path

from rich.console import Console

from asca_pillars.commands.eval_files import claim, write_report
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.open_split import open_split
from asca_pillars.errors import ConfigError
from asca_pillars.evaluation.report_page import ReportPage
from asca_pillars.evaluation.tracking.tracking_report import (
    tracking_json,
    tracking_notes,
    tracking_report,
    tracking_tables,
)
from asca_pillars.system import describe_environment


def check_arguments(
    model: Path | None, labels: Path | None, gallery: int | None, score: float | None, *, around: bool
) -> None:
    """Refuse options of other protocols, with a ConfigError."""
    if model is not None:
        raise ConfigError(f"{model}: --protocol tracking runs no model; give --predictions, of asca detect --track")
    if around:
        raise ConfigError("--around runs a model; --protocol tracking scores tracks as they are: leave it out")
    if labels is not None:
        raise ConfigError(f"--labels {labels} belongs to --protocol kitti and waymo; give --data ROOT alone")
    if gallery:
        raise ConfigError(f"--gallery {gallery} belongs to --protocol kitti; `asca detect` draws scans with boxes")
    if score is not None:
        raise ConfigError(
            f"--score {score:g}: --protocol tracking goes over all tracks; give it to asca detect --track"
        )


def evaluate_tracks(
    data: Path | None, split: str, predictions: Path | None, out: Path, json_path: Path | None, console: Console
) -> None:
    """Score tracks; print and write the table and the JSON.

    Raises:
        AscaError: an option is missing, or a file cannot be read.
    """
    if data is None or predictions is None:
        raise ConfigError("--protocol tracking: give --data ROOT and --predictions, the output of asca detect --track")
    labels = open_split(data, split)
    if not isinstance(labels, BoxSplit):
        raise ConfigError(f"--protocol tracking: {data} has no identities; give sequences of asca simulate --sequences")
    claim(out, json_path)
    about = {"data": str(data), "split": split, "predictions": str(predictions), "environment": describe_environment()}
    report = tracking_report(labels, predictions, f"{predictions} against {data}, {split}", about)
    page = ReportPage(report.subject, tracking_tables(report), tracking_notes(report))
    write_report("tracking", page, tracking_json(report), out, json_path, predictions, console)
    console.print(f"Written to {out}/", highlight=False)
