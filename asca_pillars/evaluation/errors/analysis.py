"""Preparation of an error analysis: datasets to compare, and the report."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from asca_pillars.base.progress import Reporter
from asca_pillars.data.frames import LabeledSplit
from asca_pillars.evaluation.errors.error_frames import ErrorFrames
from asca_pillars.evaluation.errors.error_report import ErrorReport, parts_of, read_report, write_errors
from asca_pillars.evaluation.report_files import MADE_BY
from asca_pillars.evaluation.report_page import ReportPage


@dataclass(frozen=True)
class ErrorAnalysis:
    """Inputs of an error analysis.

    Attributes:
        name: name of the data in the tables.
        parts: frame ids of each part of the data, by its name.
        beside: reports of other evaluations.
    """

    name: str
    parts: dict[str, list[str]]
    beside: tuple[ErrorReport, ...]


def prepare_errors(who: str, split: LabeledSplit, by: str | None, beside: Sequence[Path]) -> ErrorAnalysis:
    """Read the inputs of an error analysis: before a model runs, so that errors are found early.

    Args:
        who: name of the model or its predictions.
        split: the frames.
        by: see `evaluation.errors.error_report.parts_of`; None for no parts.
        beside: errors.json of other evaluations, for the same tables.

    Raises:
        ConfigError, DatasetError: as `parts_of` and `read_report`.
    """
    root = Path(split.root)
    where = f"{who} {root.resolve().name}"
    parts = {} if by is None else parts_of(root, split.name, split.frame_ids, by)
    named = {f"{where}/{part}": ids for part, ids in parts.items()}
    return ErrorAnalysis(f"{where}/{split.name}", named, tuple(read_report(path) for path in beside))


def predictions_name(predictions: Path) -> str:
    """Return the model's name if `asca eval` wrote the predictions, else that of the file or folder."""
    made_by = (predictions if predictions.is_dir() else predictions.parent) / MADE_BY
    try:
        return str(json.loads(made_by.read_text(encoding="utf-8"))["model"]["name"])
    except (OSError, ValueError, KeyError, TypeError):
        return predictions.name


def report_errors(
    analysis: ErrorAnalysis,
    frames: ErrorFrames,
    scores: dict[str, float],
    subject: str,
    about: dict[str, Any],
    out: Path,
    reporter: Reporter,
) -> ReportPage:
    """Analyze the errors and write the report; `scores` has the classes to evaluate."""
    return write_errors(
        frames,
        scores,
        subject=subject,
        name=analysis.name,
        parts=analysis.parts,
        beside=analysis.beside,
        about=about,
        out=out,
        reporter=reporter,
    )
