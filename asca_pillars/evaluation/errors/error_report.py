"""The report of the error analysis: errors.json, errors.md and errors.html in one folder."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from asca_pillars.base.errors import ConfigError, DatasetError
from asca_pillars.base.files import write_json, write_text
from asca_pillars.base.own_files import Recognizer, ending_with, json_object, page_end, require_own_file
from asca_pillars.base.schema import parse, to_dict
from asca_pillars.base.strict import Strict
from asca_pillars.data.kitti.kitti_split import read_image_set
from asca_pillars.evaluation.errors.error_frames import ErrorFrames
from asca_pillars.evaluation.errors.error_page import error_page
from asca_pillars.evaluation.errors.error_summary import DatasetErrors, match_frames, summarize
from asca_pillars.evaluation.errors.error_tables import PRINTED_NOTES, error_notes, error_tables, group_tables
from asca_pillars.evaluation.errors.worst_cases import draw_cases, worst_cases
from asca_pillars.evaluation.report_page import ReportPage
from asca_pillars.scans.find_scans import visible_files

JSON, MARKDOWN, PAGE = "errors.json", "errors.md", "errors.html"
_COMMAND = "asca eval"
_END = page_end(_COMMAND)
PRODUCTS: dict[str, Recognizer] = {
    JSON: json_object("subject", "datasets", "about"),
    MARKDOWN: ending_with(_END),
    PAGE: ending_with(_END),
}
"""What is written, and how it is recognized as ours."""
BY_LIST = "list"


@dataclass(frozen=True)
class ErrorReport(Strict):
    """What errors.json holds.

    Attributes:
        subject: the model or folder and the data, in words.
        datasets: the whole, then its parts.
        about: model, command, machine and versions.
    """

    subject: str
    datasets: tuple[DatasetErrors, ...]
    about: dict[str, Any]


def read_report(path: Path) -> ErrorReport:
    """Read an errors.json.

    Raises:
        DatasetError: there is none, or it is no such file.
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
        raise DatasetError(f"{path}: no errors.json of asca eval --errors; give one")
    return parse(ErrorReport, content, str(path))


def parts_of(root: Path, split: str, frame_ids: Sequence[str], by: str) -> dict[str, list[str]]:
    """Divide frames into parts whose rows stand beside those of the whole.

    Args:
        root: of the dataset.
        split: name of the list that is evaluated.
        frame_ids: of it.
        by: BY_LIST for the other lists of ImageSets/, of which each that lies within the frames is a part; or a whole
            number, by as many characters as begin the frame ids.

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
    console: Console,
) -> None:
    """Analyze the errors of an evaluation; print the main table and write JSON, Markdown and page below `out`.

    Args:
        frames: labels and predictions.
        scores: for each class to evaluate, from which on detections count.
        subject: what was evaluated, in words.
        name: of the dataset in the tables.
        parts: frame ids of each part, by its name.
        beside: reports of other evaluations, whose datasets stand in the same tables.
        about: for the JSON.
        out: folder of the evaluation.
        console: to print on.

    Raises:
        DatasetError, ScanError: a frame cannot be read.
        OutputError, OSError: a file cannot be written.
    """
    matches = match_frames(frames, scores, console=console)
    own = summarize(matches, name, parts, console=console)
    datasets = [*own, *(data for report in beside for data in report.datasets)]
    sections = worst_cases(matches)
    pictured = draw_cases(frames, matches, sections, console=console)
    notes, tables, more = error_notes(datasets), error_tables(datasets), group_tables(datasets)
    title = f"{subject}: errors"
    ReportPage(title, tables, notes[:PRINTED_NOTES]).print(console)
    write_json(out / JSON, to_dict(ErrorReport(subject, tuple(own), about)))
    write_text(out / MARKDOWN, ReportPage(title, [*tables, *more], notes).markdown() + _END)
    write_text(out / PAGE, error_page(title, tables, more, notes, pictured) + _END)


def remove_errors(out: Path) -> None:
    """Remove the report that an earlier evaluation left.

    Raises:
        OutputError: something else has one of its names.
    """
    for name, is_own in PRODUCTS.items():
        require_own_file(out / name, _COMMAND, is_own)
        (out / name).unlink(missing_ok=True)
