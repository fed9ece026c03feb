"""Output files of `asca eval`: a page of tables, its JSON, and the predictions of its own run."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from asca_pillars.base.errors import OutputError
from asca_pillars.base.files import remove_directory, require_writable, write_json, write_text
from asca_pillars.base.own_files import (
    Recognizer,
    ending_with,
    is_own_picture,
    json_object,
    page_end,
    require_not_input,
    require_own,
    require_own_file,
    require_replaceable,
)
from asca_pillars.evaluation import gallery
from asca_pillars.evaluation.errors.error_report import PRODUCTS as ERROR_PRODUCTS
from asca_pillars.evaluation.errors.error_report import remove_errors
from asca_pillars.evaluation.report_page import ReportPage

COMMAND = "asca eval"
CURVES = "curves.png"
REPORTS = {
    "report": json_object("subject", "frames_asked", "results", "bands", "operating_points"),
    "waymo": json_object("subject", "frames_asked", "results", "means", protocol="waymo"),
    "iou": json_object("subject", "shortage", "iou", "at_score", protocol="iou"),
    "distance": json_object("subject", "shortage", "nuscenes", "at_score", protocol="distance"),
    "tracking": json_object("subject", "frames_found", "not_scored", "classes"),
}
"""Recognizer of the JSON of each report, by the name of its file."""
_PAGE_END = page_end(COMMAND)
_PRODUCTS: dict[str, Recognizer] = {
    **{f"{name}.json": is_own for name, is_own in REPORTS.items()},
    **{f"{name}.md": ending_with(_PAGE_END) for name in REPORTS},
    CURVES: is_own_picture,
    **ERROR_PRODUCTS,
}
MADE_BY = "made_by.json"
PREDICTIONS_FOLDER = (COMMAND, MADE_BY, json_object("model", "data", "split", "files"))
"""Command, marker and recognizer of the folder of a model's predictions, as for `atomic_directory`."""
GALLERY_FOLDER = (COMMAND, gallery.INDEX, ending_with(gallery.INDEX_END))
"""Command, marker and recognizer of the folder of pictures."""


def check_output_folder(
    name: str,
    out: Path,
    json_path: Path | None,
    predictions: Path | None,
    inputs: Iterable[str | Path | None],
) -> None:
    """Make sure that nothing but earlier evaluations is replaced, and none of the inputs.

    Args:
        name: name of the report, see REPORTS.
        out: output folder.
        json_path: path of a copy of the JSON; None for none.
        predictions: evaluated predictions, possibly those of an earlier evaluation in `out`; None: a model is run.
        inputs: other files that are read; None is ignored.

    Raises:
        OutputError, OSError: a file cannot be replaced; names it.
    """
    inputs = list(inputs)
    require_own(out, COMMAND, {**_PRODUCTS, f"predictions/{MADE_BY}": PREDICTIONS_FOLDER[2]})
    for folder, kind in (("predictions", PREDICTIONS_FOLDER), ("gallery", GALLERY_FOLDER)):
        require_replaceable(out / folder, *kind)
    for product in ("gallery", *_PRODUCTS):
        require_not_input(out / product, [predictions, *inputs])
    if predictions is None or not _is_within(predictions, out / "predictions"):  # that folder is removed or replaced
        require_not_input(out / "predictions", inputs)
    if json_path is not None:
        others = {(out / product).resolve() for product in _PRODUCTS} - {(out / f"{name}.json").resolve()}
        if json_path.resolve() in others:
            raise OutputError(f"{json_path}: another file of the evaluation has that name; choose another one")
    require_writable(json_path, COMMAND, REPORTS[name], [predictions, *inputs])


def write_report(
    name: str,
    page: ReportPage,
    content: dict[str, Any],
    out: Path,
    json_path: Path | None,
    scored: Path,
) -> None:
    """Write `name`.json and `name`.md below `out`, and the JSON to `json_path`, too.

    An earlier evaluation's analysis of errors is removed.

    Args:
        name: name of the files, see REPORTS.
        page: contents of the Markdown file.
        content: contents of the JSON file.
        out: output folder of the evaluation, see `check_output_folder`.
        json_path: None for no other copy.
        scored: evaluated predictions; those of an earlier evaluation in `out` are removed.

    Raises:
        OutputError, OSError: something cannot be written or removed.
    """
    _remove_predictions_of_another(out, scored)
    remove_errors(out)
    for path in (out / f"{name}.json", *([] if json_path is None else [json_path])):
        require_own_file(path, COMMAND, REPORTS[name])
        write_json(path, content)
    write_text(out / f"{name}.md", page.markdown() + _PAGE_END)


def _remove_predictions_of_another(out: Path, scored: Path) -> None:
    if not _is_within(scored, out / "predictions"):
        remove_directory(out / "predictions", *PREDICTIONS_FOLDER)


def _is_within(path: Path, folder: Path) -> bool:
    return folder.resolve() in (path.resolve(), *path.resolve().parents)
