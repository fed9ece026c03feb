"""Evaluation of tracks written by `asca detect --track`."""

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.system import describe_environment
from asca_pillars.data.boxes.box_split import BoxSplit
from asca_pillars.data.open_split import open_split
from asca_pillars.evaluation.arguments import Evaluation, EvaluationTask
from asca_pillars.evaluation.report_files import check_output_folder, write_report
from asca_pillars.evaluation.report_page import ReportPage
from asca_pillars.evaluation.tracking.tracking_report import (
    tracking_json,
    tracking_notes,
    tracking_report,
    tracking_tables,
)


def evaluate_tracks(task: EvaluationTask) -> Evaluation:
    """Score tracks; write the table and the JSON.

    Raises:
        AscaError: a file cannot be read, or has no identities.
    """
    data, predictions, split = task.data, task.predictions, task.split_name
    assert data is not None and predictions is not None, "checked with the arguments"
    labels = open_split(data, split)
    if not isinstance(labels, BoxSplit):
        raise ConfigError(f"--protocol tracking: {data} has no identities; give sequences of asca simulate --sequences")
    check_output_folder("tracking", task.out, task.json, predictions, (data,))
    about = {"data": str(data), "split": split, "predictions": str(predictions), "environment": describe_environment()}
    report = tracking_report(labels, predictions, f"{predictions} against {data}, {split}", about)
    page = ReportPage(report.subject, tracking_tables(report), tracking_notes(report))
    content = tracking_json(report)
    write_report("tracking", page, content, task.out, task.json, predictions)
    return Evaluation("tracking", content, page, None, task.out)
